"""Version of the package."""


def package_version() -> str:
    """Version of the installed package, as in package.xml; "unknown" without an installation."""
    # Costs some ten milliseconds to import.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hand_eye_calib")
    except PackageNotFoundError:
        return "unknown"
