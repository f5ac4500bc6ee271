"""Errors, options, texts and plain values that every layer uses."""
