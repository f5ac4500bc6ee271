"""Gate for changes of the package: errors and stated uncertainties must not become worse."""
