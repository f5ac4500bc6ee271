"""The result of a calibration: its types, its verdict, its document in files."""
