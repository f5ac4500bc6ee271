"""Figures and reports: the only place where Matplotlib is imported."""
