"""The study of vehicles that drive over ramps until their session ends."""

import numpy as np

from reproduction.session import ramps


def test_a_session_that_is_too_short_does_not_end(monkeypatch):
    monkeypatch.setattr(ramps, "_ENDS_S", np.array([10.0, 14.0]))
    rows = ramps.ends(1)
    assert [row.rule for row in rows] == ["", *map(str, ramps.RULES)]
    assert np.isnan([row.worst for row in rows]).all()


def test_the_table_compares_the_sessions_that_ended_by_rule():
    rows = [
        ramps.End("", worst=0.5, wait_s=40.0, n_times=10, n_good_times=9),
        ramps.End("", worst=1.5, wait_s=60.0, n_times=10, n_good_times=7),
        ramps.End("", change_s=4.0),
    ]
    header, _, line = ramps.table(rows).splitlines()
    cells = dict(zip(header.split("|"), line.split("|"), strict=True))
    values = {name.strip(): cell.strip() for name, cell in cells.items()}
    assert values["ended"] == "2 of 3"
    assert values["worst axis within target"] == "50%"
    assert values["largest error / target"] == "1.50"
    assert values["time left within a factor of two"] == "80% of 20"
    assert values["change the motion (s)"] == "4"
