"""A few structured inputs of every format in the suite; ``make fuzz`` runs thousands."""

import faulthandler
import shutil

import pytest
from fuzz.inputs import FORMATS, exercise

SEEDS = {name: range(1, 25) for name in FORMATS}


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
