"""A few structured inputs of every format in the suite; ``make fuzz`` runs thousands."""

import faulthandler
import shutil
from pathlib import Path

import pytest
from fuzz.inputs import FORMATS, again, exercise

SEEDS = {name: range(1, 25) for name in FORMATS}
# Files that were found to do what must not be.
FOUND = sorted((Path(__file__).parent / "found").iterdir())


@pytest.fixture(autouse=True)
def _nothing_hangs():
    """Whatever takes minutes is a hang: it ends the run with the place it hangs at."""
    faulthandler.dump_traceback_later(600, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.mark.parametrize("name", FORMATS)
def test_structured_inputs_end_in_an_answer_or_in_one_line(tmp_path, name):
    codes = []
    for seed in SEEDS[name]:
        codes.append(exercise(name, seed, tmp_path))
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()
    # The fuzzer makes both: inputs that are read and inputs that are refused.
    if name != "metadata":  # whatever that says, the bag beside it is read
        assert {code == 0 for code in codes} == {True, False}, codes


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_files_that_once_failed(tmp_path, path):
    again(path, tmp_path)
