"""What ``benchmarks/run.py`` measures, compares and shows."""
