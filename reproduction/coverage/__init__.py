"""The coverage study: do the stated uncertainties hold, and how close are the errors to the least
possible? On simulated recordings with the Cramer-Rao bound, and on real ones with known answers.
"""
