"""What is known beforehand: as an option, weighed against the motion, and said in the verdicts."""

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, planar_poses, wandering_poses, write_pair

from hand_eye_calib.cli.main import main
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.results import load_result
from hand_eye_calib.results.calibration import DofVerdict, SolveStatus, Verdict
from hand_eye_calib.text import parse_prior

pytestmark = pytest.mark.usefixtures("no_figures")

# A sensor on a mast, looking back.
MOUNT = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0.0, 0.0, np.pi - 0.2])), [0.6, -0.3, 1.85]
)


def flat_drive(noise=0.001, mount=MOUNT):
    poses = planar_poses(400)
    child = disturbed(child_of(poses, mount), 2, noise, noise)
    return as_trajectory(disturbed(poses, 1, noise, noise)), as_trajectory(child)


def sigmas(result):
    return {dof.name: dof.sigma for dof in result.observability}


class TestOption:
    @pytest.mark.parametrize(
        ("name", "text", "prior"),
        [
            ("prior.z", "1.85+/-0.02", {"z": (1.85, 0.02)}),
            ("prior.z", "185cm +/- 20mm", {"z": (1.85, 0.02)}),
            ("prior.z", "1.85+-0.02", {"z": (1.85, 0.02)}),
            ("prior.x", "-.5±1e-2", {"x": (-0.5, 0.01)}),
            ("prior.yaw", "-90deg+/-2deg", {"yaw": (-np.pi / 2, np.radians(2))}),
            ("prior.roll", "0.1+/-0.05", {"roll": (0.1, 0.05)}),
            ("prior.y", "", {}),
        ],
    )
    def test_values_with_units(self, name, text, prior):
        parsed = parse_prior(name, text)
        assert list(parsed) == list(prior)
        for axis, pair in prior.items():
            assert parsed[axis] == pytest.approx(pair)

    @pytest.mark.parametrize(
        ("name", "text", "message"),
        [
            ("prior_z", "1.85", "with its standard deviation"),
            ("prior_z", "1.85+/-0", "standard deviation above 0"),
            ("prior_z", "1.85deg+/-0.02", "numbers in m or cm or mm"),
            ("prior_z", "high+/-0.02", "numbers in m or cm or mm"),
            ("prior_yaw", "-90+/-2", "write -90deg"),
            ("prior_x", "1e999+/-1", r"at most 1e\+06 m; got '1e999'"),
            ("prior_x", "1+/-1e200", r"at most 1e\+06 m; got '1e200'"),
            ("prior_yaw", "1+/-1e999", r"at most 1e\+06 rad; got '1e999'"),
            ("prior_transform", "1 2 3+/-0.1", "X Y Z ROLL PITCH YAW"),
        ],
    )
    def test_what_does_not_say_enough_is_refused(self, name, text, message):
        with pytest.raises(ConfigError, match=message):
            CalibratorConfig(**{name: text})


class TestFlatGround:
    def test_prior_fills_in_what_is_unknown(self):
        result = calibrate(*flat_drive(), reference="B10", prior={"z": (1.85, 0.02)})
        assert result.status is SolveStatus.OK
        assert result.unobservable() == []
        np.testing.assert_allclose(result.T_parent_child[:3, 3], MOUNT[:3, 3], atol=0.03)
        verdicts = {dof.name: dof.verdict for dof in result.observability}
        assert verdicts["z"] is DofVerdict.PRIOR
        assert verdicts["yaw"] is DofVerdict.OBSERVED
        assert sigmas(result)["z"] == pytest.approx(0.02, rel=0.05)
        assert any(
            "z of the child sensor: mostly from the prior" in warning for warning in result.warnings
        )

    def test_whole_nominal_transform(self):
        result = calibrate(
            *flat_drive(),
            reference="B10",
            prior={"transform": "0.6 -0.3 1.85 0 0 168.5deg+/-0.1 10deg"},
        )
        assert result.status is SolveStatus.OK
        assert result.T_parent_child[2, 3] == pytest.approx(1.85, abs=0.01)
        assert sigmas(result)["z"] == pytest.approx(0.1, rel=0.1)

    @pytest.mark.parametrize("method", ["dnlo", "dnl", "park", "taylor", "zhuang", "ali"])
    def test_every_method_takes_it(self, method):
        # Zhuang's starts at no rotation and this mount is nearly half a turn.
        mount = se3.from_rotation_translation(
            se3.rotation_exp(np.array([0.0, 0.0, 0.4])), MOUNT[:3, 3]
        )
        # Rotations alone do not show where x points on flat ground: the paper's two-stage methods
        # need the yaw too.
        prior = {"z": (1.85, 0.02), "yaw": (0.4, 0.001)}
        parent, child = flat_drive(noise=0.0005, mount=mount)
        result = calibrate(parent, child, method=method, reference="B10", prior=prior)
        assert result.T_parent_child[2, 3] == pytest.approx(1.85, abs=0.03)


@pytest.fixture(scope="module")
def wandering():
    """Two streams of full motion, and their calibration without a prior."""
    poses = wandering_poses(300)
    streams = [
        as_trajectory(disturbed(each, seed, 0.01, 0.005))
        for seed, each in ((1, poses), (2, child_of(poses, MOUNT)))
    ]
    return streams, calibrate(*streams, reference="B10")


class TestFullMotion:
    def test_a_vague_prior_changes_nothing(self, wandering):
        streams, plain = wandering
        vague = calibrate(*streams, reference="B10", prior={"z": (0.0, 100.0)})
        np.testing.assert_allclose(vague.T_parent_child, plain.T_parent_child, atol=1e-5)
        assert [dof.verdict for dof in vague.observability] == [
            dof.verdict for dof in plain.observability
        ]

    @pytest.mark.parametrize(
        ("axis", "prior"),
        [("x", (-0.6, 0.001)), ("x", (100.0, 1e-9)), ("z", (15.0, 0.05)), ("yaw", (0.2, 0.01))],
    )
    def test_a_contradiction_is_refused_and_the_prior_left_out(self, wandering, axis, prior):
        streams, plain = wandering
        result = calibrate(*streams, reference="B10", prior={axis: prior})
        assert result.status is SolveStatus.CONTRADICTED
        assert result.status.failure == "a prior contradicts the motion"
        assert result.verdict is Verdict.DO_NOT_USE
        assert result.reasons[0].sentence.startswith(f"the prior on {axis} is ")
        assert result.reasons[0].what_to_do == f"check value, unit and sign of prior.{axis}"
        np.testing.assert_array_equal(result.T_parent_child, plain.T_parent_child)
        np.testing.assert_array_equal(result.covariance, plain.covariance)


def test_along_an_unobservable_axis_only_an_impossible_distance_contradicts():
    # A boom of 15 m is longer than "unknown" assumes, and the motion says nothing about it.
    long = calibrate(*flat_drive(), reference="B10", prior={"z": (15.0, 0.05)})
    assert long.status is SolveStatus.OK
    assert long.T_parent_child[2, 3] == pytest.approx(15.0, abs=0.05)
    in_millimetres = calibrate(*flat_drive(), reference="B10", prior={"z": (1850.0, 20.0)})
    assert in_millimetres.status is SolveStatus.CONTRADICTED
    assert in_millimetres.unobservable() == ["z"]


def test_the_command_refuses_a_contradiction(tmp_path, capsys):
    paths = write_pair(tmp_path, *flat_drive())
    frames = ["--parent-frame", "lidar", "--child-frame", "camera"]
    command = ["calibrate", *paths, *frames, "--reference", "B10", "--out", str(tmp_path / "out")]
    assert main([*command, "--prior", "x=100+/-1e-9"]) == 1
    captured = capsys.readouterr()
    assert "the prior on x is " in captured.err
    assert captured.out.startswith("DO NOT USE: the prior on x is ")
    assert "static_transform" not in captured.out
    assert load_result(tmp_path / "out").status is SolveStatus.CONTRADICTED
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["extrinsic.yaml", "report.html"]
