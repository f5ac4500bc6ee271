"""Several sensors of one rig: extrinsics, closure, and the command."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from result_making import written_finding

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.checks.findings import finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import Severity
from hand_eye_calib.extras.rig import command
from hand_eye_calib.extras.rig import rig as of_rig
from hand_eye_calib.extras.rig.command import as_lines
from hand_eye_calib.extras.rig.page import render_rig
from hand_eye_calib.extras.rig.rig import RigCalibration, advice_for_pair
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.results import save_rig
from hand_eye_calib.offline.cli import present
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.offline.cli.present import gravest_code
from hand_eye_calib.offline.cli.reading import FilesRead
from reproduction.rig import simulated, unequal


def trajectories_of(rig):
    names = ("lidar", "front", "rear")
    return {
        name: hec.Trajectory(rig.stamps_ns, poses)
        for name, poses in zip(names, rig.poses, strict=True)
    }


@pytest.fixture(scope="module")
def rig():
    return simulated(4, 500, unequal(3))


@pytest.fixture(scope="module")
def calibrated(rig):
    return hec.calibrate_rig(trajectories_of(rig))


def test_extrinsics_and_closure(rig, calibrated):
    assert calibrated.sensors == ("lidar", "front", "rear")
    assert calibrated.verdict is not hec.Verdict.DO_NOT_USE
    for sensor, calibration in enumerate(calibrated.calibrations, start=1):
        error = se3.log(
            se3.inverse(rig.Xs[sensor]) @ calibration.T_parent_child
        )
        # One of 200 chi-squares with six degrees of freedom is larger.
        assert (
            error @ np.linalg.solve(calibration.covariance_measured, error)
            < 18.5
        )
        assert (calibration.parent_frame, calibration.n_poses) == ("lidar", 500)
    chain = (
        calibrated.T("lidar", "front")
        @ calibrated.T("front", "rear")
        @ calibrated.T("rear", "lidar")
    )
    assert_allclose(chain, np.eye(4), atol=1e-12)
    (closure,) = calibrated.closures
    assert closure.closes
    assert 0.0 < closure.chi2 < 16.8
    assert closure.dof == 6
    error = se3.log(
        se3.inverse(rig.Xs[1]) @ rig.Xs[2] @ calibrated.T("rear", "front")
    )
    between = se3.adjoint(calibrated.T("front", "rear")) @ np.linalg.cholesky(
        calibrated.covariance_measured("front", "rear")
    )
    assert (np.linalg.solve(between, error) ** 2).sum() < 18.5
    assert "3 sensors" in repr(calibrated)


def test_a_sensor_of_inverse_poses_is_named_and_closes(rig):
    lidar, front, rear = trajectories_of(rig).values()
    observed = hec.Trajectory(
        front.stamps_ns, se3.inverse(front.poses), "tag", "front_camera"
    )
    calibrated = hec.calibrate_rig(
        {"/lidar": lidar, "tag": observed, "rear": rear}
    )
    assert calibrated.sensors == ("lidar", "front_camera", "rear")
    assert [
        calibration.child_frame for calibration in calibrated.calibrations
    ] == [
        "front_camera",
        "rear",
    ]
    assert_allclose(calibrated.T("lidar", "front_camera"), rig.Xs[1], atol=0.05)
    (closure,) = calibrated.closures
    assert closure.closes


def test_two_good_sensors_do_not_suffer_from_a_bad_first_one():
    """Their own answer for each other decides, by what the answers with the first one close."""
    rig = simulated(3, 400, unequal(3) * [[6.0], [1.0], [1.0]])
    calibrated = hec.calibrate_rig(trajectories_of(rig))
    direct = calibrated.neighbours[0].T_parent_child
    apart = se3.log(se3.inverse(direct) @ calibrated.T("front", "rear"))
    sigmas = np.sqrt(np.diag(calibrated.neighbours[0].covariance_measured))
    assert (np.abs(apart) < 0.5 * sigmas).all()
    own, with_first = (
        calibrated.covariance_measured(name, "rear")
        for name in ("front", "lidar")
    )
    assert np.trace(own) < 0.5 * np.trace(with_first)


@pytest.fixture
def turned_neighbour(calibrated):
    """Return the result for front and rear with an error of 20 standard deviations about x."""
    (neighbour,) = calibrated.neighbours
    error = np.zeros(6)
    error[3] = 20.0 * np.sqrt(neighbour.covariance_measured[3, 3])
    return dataclasses.replace(
        neighbour, T_parent_child=neighbour.T_parent_child @ se3.exp(error)
    )


def test_both_results_of_a_loop_that_does_not_close_are_used_with_care(
    calibrated, turned_neighbour
):
    assert calibrated.verdict is hec.Verdict.USE
    opened = RigCalibration.of(
        calibrated.sensors, calibrated.calibrations, [turned_neighbour]
    )
    assert not opened.closures[0].closes
    assert opened.verdict is hec.Verdict.USE_WITH_CARE
    for result in opened.calibrations:
        warnings = [
            found
            for found in result.findings
            if found.severity is not Severity.NOTE
        ]
        assert [found.code for found in warnings] == ["not_closed"]
        assert result.verdict is hec.Verdict.USE_WITH_CARE
    text = "\n".join(as_lines(opened))
    sentence = (
        "the three pairwise results of lidar, front and rear do not close"
    )
    assert text.count(sentence) == 2


def test_a_bad_result_of_a_loop_does_not_lower_the_verdict_of_the_other(
    calibrated, turned_neighbour
):
    good, other = calibrated.calibrations
    bad = dataclasses.replace(other, findings=(JUMPS,))
    opened = RigCalibration.of(
        calibrated.sensors, [good, bad], [turned_neighbour]
    )
    assert not opened.closures[0].closes
    verdicts = [result.verdict for result in opened.calibrations]
    assert verdicts == [hec.Verdict.USE, hec.Verdict.DO_NOT_USE]


@pytest.mark.parametrize(
    "mounted", [False, True], ids=["same frame", "other frame"]
)
def test_copies_of_a_sensor_other_than_the_first_are_not_used(rig, mounted):
    lidar, front, rear = trajectories_of(rig).values()
    X = (
        se3.exp(np.array([0.3, -0.2, 0.1, 0.5, 0.4, -0.7]))
        if mounted
        else np.eye(4)
    )
    copy = hec.Trajectory(front.stamps_ns, front.poses @ X)
    calibrated = hec.calibrate_rig(
        {"lidar": lidar, "front": front, "rear": rear, "copy": copy}
    )
    assert calibrated.verdict is hec.Verdict.DO_NOT_USE
    verdicts = [
        result.verdict is hec.Verdict.USE for result in calibrated.calibrations
    ]
    assert verdicts == [False, True, False]
    for result in (calibrated.calibrations[0], calibrated.calibrations[2]):
        assert result.findings[0].code == "not_independent"
        assert result.findings[0].what.startswith(
            "front and copy: both streams agree"
        )
    assert calibrated.headline == (
        "DO NOT USE: front and copy of 4 sensors; USE: rear"
    )


def test_sensors_called_exact_are_no_copies_and_have_less_allowance(
    rig, calibrated
):
    trajectories = trajectories_of(rig)
    copy = trajectories["front"].poses @ se3.exp(np.full(6, 0.2))
    trajectories["rear"] = hec.Trajectory(trajectories["front"].stamps_ns, copy)
    exact = hec.calibrate_rig(
        trajectories, {"parent_kind": "exact", "child_kind": "exact"}
    )
    # Copies are never used without these options, as the test above shows.
    assert exact.verdict is hec.Verdict.USE_WITH_CARE
    assert (
        exact.calibrations[0].allowance < calibrated.calibrations[0].allowance
    ).all()


def test_advice_that_a_rig_refuses_names_the_two_sensors(calibrated):
    result = calibrated.calibrations[0]
    assert advice_for_pair(result) == ""
    inverse = finding("inverse", "child", options={"child_invert": "poses"})
    bad = dataclasses.replace(result, findings=(inverse,))
    assert advice_for_pair(bad).endswith("calibrate lidar and front alone")


def test_what_is_of_two_sensors_is_refused(rig):
    trajectories = trajectories_of(rig)
    with pytest.raises(InputError, match="at least three"):
        hec.calibrate_rig(
            {name: trajectories[name] for name in ("lidar", "front")}
        )
    for options in (
        {"prior.z": "1.0 +/- 0.1"},
        {"time_offset": 0.1},
        {"parent_frame": "a"},
    ):
        with pytest.raises(ConfigError, match=next(iter(options))):
            hec.calibrate_rig(trajectories, options)
    trajectories["rear"] = dataclasses.replace(
        trajectories["rear"], measures="positions"
    )
    with pytest.raises(InputError, match="rear measures positions only"):
        hec.calibrate_rig(trajectories)


@pytest.fixture
def files(rig, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, trajectory in trajectories_of(rig).items():
        hec.write_trajectory(f"{name}.txt", trajectory)
    return ["lidar.txt", "front.txt", "rear.txt"]


def test_the_command_prints_and_saves_all_sensors(files, capsys, tmp_path):
    assert main(["calibrate", *files, "--out", "rig", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sensors"] == ["lidar", "front", "rear"]
    assert document["inputs"]["files"] == files
    page = (tmp_path / "rig/report.html").read_text(encoding="utf-8")
    assert "3 sensors in <code>lidar</code>" in page
    assert "lidar - front - rear closes: off by" in page
    launch = (tmp_path / "rig/static_transform.launch.py").read_text(
        encoding="utf-8"
    )
    compile(launch, "launch", "exec")
    assert launch.count("'--frame-id', 'lidar'") == 2
    translation = document["calibrations"]["rear"]["T_parent_child"][
        "translation"
    ]
    assert_allclose(hec.load("rig/rear").T_parent_child[:3, 3], translation)


def test_a_sensor_may_have_the_name_of_a_file(calibrated, tmp_path):
    named = [
        dataclasses.replace(calibration, child_frame="rig.yaml")
        for calibration in calibrated.calibrations
    ]
    save_rig(calibrated.to_dict(), named, tmp_path)
    assert (tmp_path / "rig.yaml").is_file()
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 2


def test_a_person_sees_all_sensors_and_whether_pairs_close(calibrated):
    lines = as_lines(calibrated)
    assert lines[0] == f"{calibrated.verdict.value}: 3 sensors"
    assert [line.split(":")[0] for line in lines if " in lidar:" in line] == [
        "front in lidar",
        "rear in lidar",
    ]
    assert any(
        line.startswith("  lidar - front - rear closes: off by")
        for line in lines
    )


def test_a_sensor_of_any_name_stays_below_the_directory(calibrated, tmp_path):
    first, second = calibrated.calibrations
    named = [
        dataclasses.replace(first, child_frame="../$x$/a"),
        dataclasses.replace(second, child_frame=".._$x$_a"),
    ]
    odd = dataclasses.replace(
        calibrated,
        sensors=("$", "../$x$/a", ".._$x$_a"),
        calibrations=tuple(named),
    )
    save_rig(odd.to_dict(), named, tmp_path / "rig")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig"]
    saved = sorted(
        path.name for path in (tmp_path / "rig").iterdir() if path.is_dir()
    )
    assert saved == ["__x__a", "__x__a_2"]
    assert "../$x$/a" in render_rig(odd, ["a.txt"])
    with pytest.raises(
        InputError, match=r"of a rig; pass the folder of one sensor: .*__x__a_2"
    ):
        hec.load(tmp_path / "rig")


def test_topics_of_a_bag(rig, tmp_path, capsys):
    streams = {}
    for name, trajectory in trajectories_of(rig).items():
        named = dataclasses.replace(
            trajectory, sensor_frame=f"{name}_link", world_frame="odom"
        )
        streams[f"/{name}/odometry"] = named, "nav_msgs/msg/Odometry"
    bag = str(tmp_path / "bag")
    write_bag(bag, streams)
    assert main(["replay", bag, "--json", "--topics", *streams]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sensors"] == ["lidar_link", "front_link", "rear_link"]
    assert document["inputs"]["topics"] == list(streams)
    assert main(["replay", bag, "--list", "--topics", *streams]) == 2
    assert "--topics cannot be combined with --list" in capsys.readouterr().err
    assert (
        main(["replay", bag, "--topics", "/lidar/odometry", "/lidar/odometry"])
        == 2
    )
    assert "have the sensor name 'lidar_link'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["rear.txt", "--parent-format", "tum"],
            "--parent-format is for two files",
        ),
        (["front.txt"], "front.txt appears twice"),
        (
            ["rear.txt", "--installed", "0 0 0 0 0 0"],
            "--installed and --base-frame apply to two",
        ),
    ],
)
def test_the_command_refuses_options_of_two_files(files, run, words, message):
    code, _, err = run("calibrate", *files[:2], *words)
    assert (code, message in err) == (2, True)


def not_converged(rig, findings=()):
    """Return the rig with a first extrinsic whose solve did not converge."""
    first, *others = rig.calibrations
    failed = dataclasses.replace(
        first, status=hec.SolveStatus.NOT_CONVERGED, findings=tuple(findings)
    )
    return dataclasses.replace(rig, calibrations=(failed, *others))


JUMPS = written_finding("jumps", Severity.ERROR, "every step is a jump")


@pytest.mark.parametrize(("findings", "code"), [((), 1), ((JUMPS,), 3)])
def test_the_exit_code_is_that_of_two_sensors(
    files, calibrated, run, monkeypatch, findings, code
):
    failed = not_converged(calibrated, findings)
    monkeypatch.setattr(of_rig, "calibrated", lambda *_: failed)
    exit_code, _, err = run("calibrate", *files)
    assert (
        exit_code
        == code
        == gravest_code(map(present.exit_code, failed.calibrations))
    )
    advice = "front: the solver did not converge; do not use this result, record more varied motion"
    assert (advice in err) == (code == 1)


def test_labels_details_and_warnings_of_files_are_obeyed_as_with_two_sensors(
    rig, files, calibrated, run, monkeypatch
):
    trajectories = [*trajectories_of(rig).values()]
    monkeypatch.setattr(of_rig, "calibrate_rig", lambda *_: calibrated)
    monkeypatch.setattr(
        command,
        "read_files",
        lambda *_: FilesRead(trajectories, [], ["look here"]),
    )
    _, out, _ = run("calibrate", *files, "--json", "--label", "vehicle=7")
    document = json.loads(out)
    assert document["inputs"]["labels"] == {"vehicle": "7"}
    for calibration in document["calibrations"].values():
        assert calibration["warnings"] == ["look here"]
    _, out, _ = run("calibrate", *files, "--verbose")
    assert "quaternion" in out
    assert "  Method: " in out
    assert "Note: look here" in out
    assert out.count("ros2 run tf2_ros static_transform_publisher") == 2


def test_the_files_of_an_earlier_run_are_kept(
    files, calibrated, run, monkeypatch, tmp_path
):
    monkeypatch.setattr(of_rig, "calibrate_rig", lambda *_: calibrated)
    run("calibrate", *files, "--out", "rig")
    earlier = (tmp_path / "rig/rig.yaml").read_bytes()
    _, _, err = run("calibrate", *files, "--out", "rig", "--label", "vehicle=7")
    assert (tmp_path / "rig/previous/rig.yaml").read_bytes() == earlier
    assert "the earlier files are in rig/previous" in err
