"""A copy of the package that a test may change."""

import shutil

from source_code import PACKAGE, SOURCE

# Without the finder of an editable install, which would find the deleted folder elsewhere.
WITHOUT_FINDER = """
import sys

sys.meta_path[:] = [
    finder for finder in sys.meta_path if "__editable__" not in getattr(finder, "__module__", "")
]
"""


def copy_of_the_package(folder):
    """Copy the package into a folder, and return the folder of the copy."""
    copy = folder / PACKAGE
    shutil.copytree(SOURCE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    return copy
