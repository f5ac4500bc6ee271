"""Versions of this package and of other packages."""

from functools import cache


@cache
def version_of(package: str = "hand_eye_calib") -> str:
    """Return the version of a package; "unknown" if the package is not installed."""
    # The import takes some ten milliseconds.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
