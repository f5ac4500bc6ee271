"""Parts of ``benchmarks/run.py``: measurements, comparison with the baseline, tables."""
