"""Experiments of Välimäki et al. 2023: published data and results, and our results on this data."""
