"""Checks that the two streams are believable before anything is solved."""
