"""Checks, before any solve, of whether both streams are plausible."""
