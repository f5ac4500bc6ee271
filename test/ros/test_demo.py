"""The demo from the outside: a process, what it prints, its exit code."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hand_eye_calib
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.extras.simulation.demo import DRIVE, TOPICS
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import REALISTIC
from hand_eye_calib.extras.simulation.player import play
from hand_eye_calib.offline.cli.main import main

# How long a hang takes to fail a test; the demo takes about 5 s.
PATIENCE_S = 300.0

# Over seeds 0 to 15 the largest errors were 10.1 mm and 0.14 deg, the medians 1.9 mm and 0.10 deg;
# the default seed had 2.7 mm and 0.07 deg.
LARGEST_ERROR_M = 0.015
LARGEST_ERROR_DEG = 0.3


def run(*arguments, domain=0):
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
        cwd=Path(hand_eye_calib.__file__).parents[1],
    )


def numbers(line):
    return [
        float(word)
        for word in re.findall(r"(?<= )-?\d[\d.]*(?:e-?\d+)?(?= |$)", line)
    ]


def test_demo_recovers_the_truth_offline_and_live_and_replaces_an_earlier_demo(
    tmp_path, domain, capsys
):
    (tmp_path / "demo_bag").mkdir()
    (tmp_path / "demo_bag" / "metadata.yaml").write_text("of an earlier demo")
    (tmp_path / "mine.txt").write_text("not of a demo")
    done = run("-m", "hand_eye_calib", "demo", "--out", tmp_path, domain=domain)
    assert done.returncode == 0, done.stderr
    headline, heads, truth, offline, online, apart = done.stdout.splitlines()
    assert headline.startswith("USE")
    assert heads.startswith("Pose of camera in lidar")
    T_true = simulate_drive(0, DRIVE, REALISTIC).T_parent_child
    assert numbers(truth)[:3] == pytest.approx(T_true[:3, 3], abs=1e-4)
    for line in (offline, online):
        apart_m = np.linalg.norm(np.subtract(numbers(line)[:3], T_true[:3, 3]))
        assert 0.0 < apart_m < LARGEST_ERROR_M
        assert (
            np.abs(np.subtract(numbers(line)[3:6], numbers(truth)[3:6])).max()
            < LARGEST_ERROR_DEG
        )
        assert re.search(r"off by [\d.]+ mm and [\d.]+ deg$", line)
    assert max(numbers(apart)) < 1e-6

    # The replay command finds the same in the bag that is left behind.
    topics = [
        "--parent-topic",
        TOPICS["parent"],
        "--child-topic",
        TOPICS["child"],
    ]
    assert main(["replay", str(tmp_path / "demo_bag"), *topics, "--json"]) == 0
    replayed = np.array(
        json.loads(capsys.readouterr().out)["T_parent_child"]["matrix"]
    )
    assert numbers(offline)[:3] == pytest.approx(replayed[:3, 3], abs=1e-4)
    remaining = ["demo_bag", "mine.txt", "node.log", "report.html"]
    assert sorted(path.name for path in tmp_path.iterdir()) == remaining


def test_demo_without_ros_says_what_to_install_and_with_it_why_it_does_not_start(
    tmp_path,
):
    command = "demo", "--out", tmp_path / "out"
    program = (
        "import sys; sys.modules['rclpy'] = None; "
        "from hand_eye_calib.offline.cli.main import main; "
        "sys.exit(main(sys.argv[1:]))"
    )
    without = run("-c", program, *command)
    assert len(without.stderr.splitlines()) == 1
    assert "rclpy is missing" in without.stderr
    assert "pip install" in without.stderr
    assert not (tmp_path / "out").exists()
    bad = run("-m", "hand_eye_calib", *command, domain="one")
    assert "error: cannot start ROS: " in bad.stderr.splitlines()[-1]
    assert (
        "ROS_DOMAIN_ID is not an integral number" in bad.stderr.splitlines()[-1]
    )
    assert [
        (process.returncode, process.stdout) for process in (without, bad)
    ] == [(1, "")] * 2


def test_player_does_not_wait_for_ever(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setattr(
        "hand_eye_calib.extras.simulation.player._PATIENCE_S", 0.1
    )
    with pytest.raises(
        HandEyeCalibError, match=r"waited 0\.1 s for the node to listen"
    ):
        play(None, TOPICS, 1.0, 0, lambda: None)


def test_live_demo_displays_a_session_from_start_to_end_and_saves_it(
    tmp_path, domain
):
    program = (
        "import sys; from hand_eye_calib.extras.simulation import demo; "
        "demo.LIVE_SPEED = 20.0; from hand_eye_calib.offline.cli.main import main; "
        "sys.exit(main(sys.argv[1:]))"
    )
    done = run(
        "-c", program, "demo", "--live", "--out", tmp_path, domain=domain
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"open http://\S+ in a browser", done.stderr)
    *_, headline, error = done.stdout.splitlines()
    assert headline.startswith("USE")
    apart_mm, apart_deg = map(
        float,
        re.match(
            r"Off the simulated truth by ([\d.]+) mm and ([\d.]+) deg; saved in ",
            error,
        ).groups(),
    )
    assert apart_mm < 1e3 * LARGEST_ERROR_M
    assert apart_deg < LARGEST_ERROR_DEG
    assert (tmp_path / "live" / "extrinsic.yaml").exists()
