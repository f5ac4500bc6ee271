"""Structured inputs of every format, each made from a seed: a finding is repeated by its format and
seed. ``make fuzz`` makes thousands.
"""

import faulthandler
import os
import resource
import shutil
import time

import pytest
from fuzz.inputs import FORMATS, exercise

N_INPUTS = int(os.environ.get("FUZZ_INPUTS", 24 * len(FORMATS))) // len(FORMATS)
FIRST_SEED = 1 if N_INPUTS == 24 else 1000
LONGEST_S, LARGEST_MB = 10.0, 1000.0


@pytest.fixture(autouse=True)
def _nothing_hangs():
    """Whatever takes minutes is a hang: it ends the run with the place it hangs at."""
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.mark.parametrize("name", FORMATS)
def test_structured_inputs_end_in_an_answer_or_in_one_line(tmp_path, name):
    codes = []
    for seed in range(FIRST_SEED, FIRST_SEED + N_INPUTS):
        faulthandler.dump_traceback_later(600, exit=True)
        began = time.process_time()
        codes.append(exercise(name, seed, tmp_path))
        assert time.process_time() - began < LONGEST_S, seed
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()
    if N_INPUTS > 24:  # in a process of its own
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 < LARGEST_MB
    # The fuzzer makes both: inputs that are read and inputs that are refused.
    if N_INPUTS >= 24:
        assert {code == 0 for code in codes} == {True, False}, codes
