"""The experiments of Välimäki et al. 2023: their data, their published results, and our answers
beside them.
"""
