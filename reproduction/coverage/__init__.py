"""The coverage study."""
