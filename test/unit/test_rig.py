"""Several sensors in one solve: likelihood, outliers, closure, and the command."""

import dataclasses
import json

import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.cli.main import main
from hand_eye_calib.cli.rig import as_lines
from hand_eye_calib.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.bags import write_bag
from hand_eye_calib.io.rig_files import save_rig
from hand_eye_calib.report.rig_page import render_rig
from hand_eye_calib.rig import solution as joint
from hand_eye_calib.rig.calibrate import solve_rig
from hand_eye_calib.rig.increments import Aligned, linearised
from hand_eye_calib.rig.likelihood import (
    Likelihood,
    Model,
    derivatives,
    walk_between,
    walk_of,
    white_of,
)
from hand_eye_calib.rig.table import Table, synchronised
from reproduction.rig import alike, simulated, unequal


def model_of(rig, aligned=None):
    increments = linearised(rig.table, rig.Xs, aligned=aligned or Aligned())
    n, white = len(increments.adjoints), white_of(rig.Xs)
    none = np.zeros((len(rig.Xs), n), dtype=bool), np.zeros((len(rig.Xs), n + 1), dtype=bool)
    return Model(increments, white, walk_of(white, np.ones(n)), *none)


def levels_of(rig):
    return 2 * np.log(rig.errors).ravel()


def trajectories_of(rig):
    names = ("lidar", "front", "rear")
    return {
        name: hec.Trajectory(rig.table.stamps_ns, poses)
        for name, poses in zip(names, rig.table.poses, strict=True)
    }


@pytest.fixture(scope="module")
def rig():
    return simulated(4, 500, unequal(3))


def test_the_derivatives_are_those_of_the_likelihood():
    rig = simulated(1, 30, unequal(3))
    model, levels = model_of(rig, Aligned(with_time=(1,), with_scale=(2,))), levels_of(rig)
    model.spikes[1, 7] = model.jumps[2, 11] = True
    gradient, _ = derivatives(Likelihood(model, levels))
    for level, expected in enumerate(gradient):
        step = np.zeros(len(levels))
        step[level] = 1e-4
        ahead, behind = (Likelihood(model, levels + sign * step).loss for sign in (1, -1))
        assert (ahead - behind) / 2e-4 == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_a_walk_over_a_gap_is_the_sum_of_its_steps():
    rig = simulated(2, 40, unequal(3))
    white, relative = white_of(rig.Xs), np.linspace(0.5, 1.5, 39)
    poses = rig.table.poses[0]
    at_once = walk_between(white, relative, poses, np.array([0, 25, 39]))
    for start, end, found in ((0, 25, at_once[:, :, 0]), (25, 39, at_once[:, :, 1])):
        expected = np.zeros_like(found)
        for step in range(start, end):
            adjoint = se3.adjoint(se3.inverse(poses[end]) @ poses[step + 1])
            expected += relative[step] * adjoint @ white @ adjoint.T
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_sensors_with_the_same_noise_learn_nothing_from_others():
    """Equations with the same regressors: the joint answer is that of each alone (Zellner 1962)."""
    rig = simulated(3, 60, alike(4))
    shared = rig._replace(Xs=np.tile(np.eye(4), (4, 1, 1)))
    step = Likelihood(model_of(shared), levels_of(shared)).normal.step
    for sensor in (1, 2, 3):
        pair = shared._replace(
            table=Table(rig.table.stamps_ns, rig.table.poses[[0, sensor]]),
            Xs=shared.Xs[:2],
            errors=rig.errors[:2],
        )
        alone = Likelihood(model_of(pair), levels_of(pair)).normal.step
        np.testing.assert_allclose(step[6 * sensor - 6 : 6 * sensor], alone, atol=1e-7)


@pytest.fixture(scope="module")
def found(rig):
    return hec.calibrate_rig(trajectories_of(rig))


def test_extrinsics_noise_and_closure(rig, found):
    assert found.sensors == ("lidar", "front", "rear")
    assert found.verdict is hec.Verdict.USE
    for sensor, calibration in enumerate(found.calibrations, start=1):
        error = se3.log(se3.inverse(rig.Xs[sensor]) @ calibration.T_parent_child)
        assert error @ np.linalg.solve(calibration.covariance, error) < 18.5  # one in 200
        assert (calibration.parent_frame, calibration.n_poses) == ("lidar", 500)
    noise = np.array([dataclasses.astuple(each)[:4] for each in found.solution.noise])
    np.testing.assert_allclose(noise[:, [1, 0]] / rig.errors[:, :2], 1.0, atol=0.2)
    np.testing.assert_allclose(noise[:, [3, 2]] / rig.errors[:, 2:], 1.0, atol=0.6)
    chain = found.T("lidar", "front") @ found.T("front", "rear") @ found.T("rear", "lidar")
    np.testing.assert_allclose(chain, np.eye(4), atol=1e-12)
    (closure,) = found.closures
    assert closure.closes
    assert 0.0 < closure.chi2 < 16.8
    assert closure.dof == 6
    between = found.covariance("front", "rear")
    assert np.linalg.eigvalsh(between)[0] > 0.0
    assert "front" in repr(found)


def test_errors_belong_to_the_sensor_that_makes_them(rig):
    poses = rig.table.poses.copy()
    poses[0, 200:] = se3.exp(np.r_[0.3, 0.0, 0.1, np.zeros(3)]) @ poses[0, 200:]
    poses[2, 330] = poses[2, 330] @ se3.exp(np.r_[np.zeros(3), 0.0, 0.2, 0.0])
    found = joint.solve(Table(rig.table.stamps_ns, poses), rig.Xs)
    counts = [(each.n_jumps, each.n_spikes) for each in found.noise]
    assert counts == [(1, 0), (0, 0), (0, 1)]
    for sensor in (1, 2):
        error = se3.log(se3.inverse(rig.Xs[sensor]) @ found.Xs[sensor])
        assert np.abs(error).max() < 0.02


def test_the_table_has_the_instants_that_all_sensors_know():
    stamps_ns = np.arange(40) * 100_000_000
    poses = se3.exp(np.c_[np.arange(40) * 0.1, np.zeros((40, 5))])
    fast = hec.Trajectory(stamps_ns, poses)
    slow = fast[1:40:2]
    with_gap = fast[np.r_[0:10, 21:40]]
    table = synchronised([fast, slow, with_gap], max_gap_s=0.5)
    assert table.stamps_ns.tolist() == [*stamps_ns[1:10:2], *stamps_ns[21:40:2]]
    np.testing.assert_allclose(table.poses[0], table.poses[2], atol=1e-12)


def test_what_is_of_two_sensors_is_refused(rig):
    trajectories = trajectories_of(rig)
    with pytest.raises(InputError, match="at least three"):
        hec.calibrate_rig({name: trajectories[name] for name in ("lidar", "front")})
    for options in ({"prior.z": "1.0 +/- 0.1"}, {"time_offset": 0.1}, {"parent_frame": "a"}):
        with pytest.raises(ConfigError, match=next(iter(options))):
            solve_rig(trajectories, options)
    trajectories["rear"] = dataclasses.replace(trajectories["rear"], measures="positions")
    with pytest.raises(InputError, match="rear measures positions only"):
        hec.calibrate_rig(trajectories)
    with pytest.raises(NotEnoughDataError, match="30 are needed"):
        joint.solve(rig.table.at(np.arange(20)), rig.Xs)


@pytest.fixture
def files(rig, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, trajectory in trajectories_of(rig).items():
        hec.write_trajectory(f"{name}.txt", trajectory)
    return ["lidar.txt", "front.txt", "rear.txt"]


def test_the_command_prints_and_saves_a_tree(files, capsys, tmp_path):
    assert main(["calibrate", *files, "--out", "rig", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sensors"] == ["lidar", "front", "rear"]
    assert document["inputs"]["files"] == files
    page = (tmp_path / "rig/report.html").read_text(encoding="utf-8")
    assert "3 sensors in <code>lidar</code>" in page
    assert "lidar - front - rear closes: off by" in page
    launch = (tmp_path / "rig/static_transform.launch.py").read_text(encoding="utf-8")
    compile(launch, "launch", "exec")
    assert launch.count("'--frame-id', 'lidar'") == 2
    saved = hec.load("rig/rear")
    np.testing.assert_allclose(
        saved.T_parent_child[:3, 3],
        document["calibrations"]["rear"]["T_parent_child"]["translation"],
    )


def test_a_person_sees_the_tree_and_whether_pairs_close(found):
    lines = as_lines(found)
    assert lines[0] == "USE: 3 sensors in one solve"
    assert lines[4].startswith("`- rear: x")
    assert any(line.startswith("  lidar - front - rear closes: off by") for line in lines)


def test_a_sensor_of_any_name_stays_below_the_directory(found, tmp_path):
    first, second = found.calibrations
    named = [
        dataclasses.replace(first, child_frame="../$x$/a"),
        dataclasses.replace(second, child_frame=".._$x$_a"),
    ]
    odd = dataclasses.replace(
        found, sensors=("$", "../$x$/a", ".._$x$_a"), calibrations=tuple(named)
    )
    save_rig(odd.to_dict(), named, tmp_path / "rig")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig"]
    saved = sorted(path.name for path in (tmp_path / "rig").iterdir() if path.is_dir())
    assert saved == ["__x__a", "__x__a_2"]
    assert "../$x$/a" in render_rig(odd, ["a.txt"])
    with pytest.raises(InputError, match=r"of a rig; name one of its sensors: .*__x__a_2"):
        hec.load(tmp_path / "rig")


def test_topics_of_a_bag(rig, tmp_path, capsys):
    streams = {
        f"/{name}/odometry": (
            dataclasses.replace(trajectory, sensor_frame=f"{name}_link", world_frame="odom"),
            "nav_msgs/msg/Odometry",
        )
        for name, trajectory in trajectories_of(rig).items()
    }
    bag = str(tmp_path / "bag")
    write_bag(bag, streams)
    assert main(["replay", bag, "--json", "--topics", *streams]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sensors"] == ["lidar_link", "front_link", "rear_link"]
    assert document["inputs"]["topics"] == list(streams)
    assert main(["replay", bag, "--every", "5s", "--topics", *streams]) == 2
    assert "--topics and --every do not go together" in capsys.readouterr().err
    assert main(["replay", bag, "--topics", "/lidar/odometry", "/lidar/odometry", "/x"]) == 2
    assert "of one sensor, 'lidar_link'" in capsys.readouterr().err


def test_the_command_refuses_options_of_two_files(files, capsys):
    assert main(["calibrate", *files, "--parent-format", "tum"]) == 2
    assert "--parent-format is of two files" in capsys.readouterr().err
    assert main(["calibrate", *files[:2], files[1]]) == 2
    assert "of one sensor, 'front'" in capsys.readouterr().err
    assert main(["calibrate", *files, "--installed", "0 0 0 0 0 0"]) == 2
    assert "--installed is of two sensors" in capsys.readouterr().err
