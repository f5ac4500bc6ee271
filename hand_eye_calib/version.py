"""Versions of the package and of others."""

from functools import cache


def package_version() -> str:
    """Version of the installed package, as in package.xml; "unknown" without an installation."""
    return version_of("hand_eye_calib")


@cache
def version_of(package: str) -> str:
    """Version of an installed package, read once; "unknown" if it is not installed."""
    # Costs some ten milliseconds to import.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
