"""``calibrate --batch`` and several recordings: tasks, workers, results (docs/bags.md)."""
