"""Inputs that were rebuilt from public bug reports, with known truth, and commands on them."""

import json

import pytest
from published_data import data_folder

from hand_eye_calib.offline.cli.main import main


def reports_folder(kind):
    """Return the folder "arms", "bags" or "files"; skip the running test where it is absent."""
    folder = data_folder() / "reports" / kind
    if not folder.is_dir():
        pytest.skip(f"no inputs of reports in {folder}")
    return folder


def calibrated(capsys, *arguments):
    """Exit code, document (None after an error) and what was written to stderr."""
    code = main(["calibrate", *arguments, "--json"])
    out, err = capsys.readouterr()
    document = json.loads(out) if out else None
    return code, document, err
