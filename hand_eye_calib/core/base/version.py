"""Versions of the package and of others."""

from functools import cache


@cache
def version_of(package: str = "hand_eye_calib") -> str:
    """Version of an installed package, read once; "unknown" without an installation."""
    # Costs some ten milliseconds to import.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
