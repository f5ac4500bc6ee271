"""What a change of the package does to errors and stated uncertainties."""
