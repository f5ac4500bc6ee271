"""Several sensors on one body, calibrated in one solve with the noise of every sensor."""
