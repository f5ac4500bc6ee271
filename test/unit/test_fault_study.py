"""The study of faults: its cases, and what its page says."""

import dataclasses

import numpy as np
import pytest

from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE
from reproduction import clean_recordings, faults
from reproduction.fault_cases import LATER


def test_there_are_more_than_a_hundred_clean_recordings_of_more_than_ten_kinds():
    names = clean_recordings.names(None)
    assert len(names) == len(set(names)) > 100
    assert len({clean_recordings.kind_of(name) for name in names}) > 10
    cases = faults.clean_cases(None)
    assert [case.recording for case in cases] == names
    assert {case.method for case in cases} == {"auto"}


def test_the_page_names_what_is_wrong_in_confidence_and_wrong_findings():
    text = faults.report(
        [
            faults.Outcome(key="S5 0 hilly_1 auto", verdict="USE", findings=[], z=4.0),
            faults.Outcome(key="S5 1 hilly_1 auto", verdict="USE WITH CARE", findings=[], z=9.0),
            faults.Outcome(key="none 0 hilly_1 auto", verdict="USE", findings=[], z=1.0),
            faults.Outcome(key="clean 0 hilly 50 auto", verdict="USE", findings=["note:jumps"]),
            faults.Outcome(
                key="clean 0 hand_mixture_30s 50 auto",
                verdict="USE WITH CARE",
                findings=["jumps", "scale"],
                rules=["warning_finding"],
            ),
        ],
        None,
    )
    assert "1 of them are more than 3.3 standard deviations off and called USE:\n- S5 0" in text
    assert "Wrong findings in 1 of 2 clean recordings" in text
    assert "| hand_mixture_30s | 1 | scale 1 |" in text


@pytest.mark.parametrize("fault", LATER, ids=lambda fault: fault.code)
def test_faults_that_were_built_last_change_the_streams(fault):
    drive = simulate_drive(0, dataclasses.replace(HILLY_DRIVE, poses=400))
    for severity in fault.severities:
        parent, child = fault.damage(drive.parent, drive.child, severity, np.random.default_rng(0))
        assert min(len(parent), len(child)) > 250
        same = len(child) == len(drive.child) and np.array_equal(child.poses, drive.child.poses)
        same &= np.array_equal(child.stamps_ns, drive.child.stamps_ns)
        assert not same or not np.array_equal(parent.poses, drive.parent.poses)


def test_a_child_in_2d_ends_in_a_verdict(monkeypatch):
    monkeypatch.setattr(faults, "_MAX_PAIRS", 100)
    case = faults.Case(fault="S10b", severity=2, recording="hilly_1", method="auto")
    assert faults.outcome(case, None).verdict == "DO NOT USE"
