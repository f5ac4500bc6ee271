"""Priors on single axes, from the option to the verdict."""

import motions
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import prior_as_typed
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import (
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.calibrate import calibrate
from hand_eye_calib.offline.cli.main import main

pytestmark = pytest.mark.usefixtures("no_figures")

# A sensor on a mast, looking back.
MOUNT = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0.0, 0.0, np.pi - 0.2])), [0.6, -0.3, 1.85]
)


def flat_drive(noise=0.001, mount=MOUNT):
    poses = motions.planar_poses(400)
    return motions.noisy_pair(poses, 1, noise, noise, mount=mount)


def sigmas(result):
    return {dof.name: dof.sigma for dof in result.observability_measured}


class TestOption:
    @pytest.mark.parametrize(
        ("name", "text", "prior"),
        [
            ("prior.z", "1.85+/-0.02", {"z": (1.85, 0.02)}),
            ("prior.z", "185cm +/- 20mm", {"z": (1.85, 0.02)}),
            ("prior.z", "1.85+-0.02", {"z": (1.85, 0.02)}),
            ("prior.x", "-.5±1e-2", {"x": (-0.5, 0.01)}),
            (
                "prior.yaw",
                "-90deg+/-2deg",
                {"yaw": (-np.pi / 2, np.radians(2))},
            ),
            ("prior.roll", "0.1+/-0.05", {"roll": (0.1, 0.05)}),
            ("prior.z", "8m+/-0.02", {"z": (8.0, 0.02)}),
            ("prior.z", "800cm+/-2cm", {"z": (8.0, 0.02)}),
            ("prior.x", "-22cm+/-20mm", {"x": (-0.22, 0.02)}),
            ("prior.y", "4.9+/-0.1", {"y": (4.9, 0.1)}),
            ("prior.y", "", {}),
        ],
    )
    def test_values_with_units(self, name, text, prior):
        field = name.replace(".", "_")
        config = CalibratorConfig(**{field: text})

        parsed = config.prior()

        assert list(parsed) == list(prior)
        for axis, value_and_sigma in prior.items():
            assert parsed[axis] == pytest.approx(value_and_sigma)

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
            ("prior_z", "-22+/-2", r"write -22cm\+/-2cm or -22m\+/-2m"),
            (
                "prior_x",
                "5.1+/-0.02",
                r"write 5.1cm\+/-0.02cm or 5.1m\+/-0.02m",
            ),
            ("prior_y", "220.0+/-20.0", "may be m, cm or mm"),
            ("prior_z", "8+/-2cm", r"write 8cm\+/-2cm or 8m\+/-2cm"),
            (
                "prior_z",
                "-22cm+/-2",
                "standard deviation 2 needs a unit: write 2cm or 2m",
            ),
            (
                "prior_yaw",
                "-90deg+/-2",
                "standard deviation 2 needs a unit: write 2deg or 2rad",
            ),
        ],
    )
    def test_what_does_not_say_enough_is_refused(self, name, text, message):
        options = {name: text}
        with pytest.raises(ConfigError, match=message):
            CalibratorConfig(**options)


class TestFlatGround:
    def test_a_prior_alone_has_no_allowance_and_can_be_used(self):
        sigmas_m = {}
        for sigma_m in (0.02, 0.005):
            result = calibrate(
                *flat_drive(), prior={"z": (1.85, sigma_m)}, checks=False
            )
            sigmas_m[sigma_m] = result.sigmas[2]
            assert result.observability[2].verdict is DofVerdict.PRIOR
            assert result.allowance[2] < 0.0005
            assert result.allowance[:2].min() > 0.005
        assert sigmas_m == pytest.approx({0.02: 0.02, 0.005: 0.005}, rel=0.02)
        assert sigmas_m[0.02] <= 0.02

    def test_a_prior_beside_a_better_estimate_keeps_the_allowance_of_that(
        self, wandering
    ):
        streams, plain = wandering
        vague = calibrate(
            *streams, reference="B10", prior={"z": (0.0, 100.0)}, checks=False
        )
        assert_allclose(vague.allowance, plain.allowance, rtol=1e-3)

    def test_prior_fills_in_what_is_unknown(self):
        result = calibrate(
            *flat_drive(), reference="B10", prior={"z": (1.85, 0.02)}
        )
        assert result.status is SolveStatus.OK
        assert result.unobservable() == []
        assert_allclose(result.T_parent_child[:3, 3], MOUNT[:3, 3], atol=0.03)
        verdicts = {dof.name: dof.verdict for dof in result.observability}
        assert verdicts["z"] is DofVerdict.PRIOR
        assert verdicts["yaw"] is DofVerdict.OBSERVED
        assert sigmas(result)["z"] == pytest.approx(0.02, rel=0.05)
        assert any(
            "z of the child sensor: mostly from the prior" in warning
            for warning in result.warnings
        )

    @pytest.mark.parametrize(
        "method", ["dnlo", "dnl", "park", "taylor", "zhuang", "ali"]
    )
    def test_every_method_takes_it(self, method):
        # Zhuang's starts at no rotation and this mount is nearly half a turn.
        mount = se3.from_rotation_translation(
            se3.rotation_exp(np.array([0.0, 0.0, 0.4])), MOUNT[:3, 3]
        )
        # Rotations alone do not show where x points on flat ground: the paper's two-stage methods
        # need the yaw too.
        prior = {"z": (1.85, 0.02), "yaw": (0.4, 0.001)}
        options = {
            "method": method,
            "reference": "B10",
            "prior": prior,
            "checks": False,
        }
        result = calibrate(*flat_drive(noise=0.0005, mount=mount), **options)
        assert result.T_parent_child[2, 3] == pytest.approx(1.85, abs=0.03)


@pytest.fixture(scope="module")
def wandering():
    """Two streams of full motion, and their calibration without a prior."""
    streams = motions.noisy_pair(
        motions.wandering_poses(300), 1, 0.01, 0.005, mount=MOUNT
    )
    return streams, calibrate(*streams, reference="B10")


class TestFullMotion:
    def test_a_vague_prior_changes_nothing(self, wandering):
        streams, plain = wandering
        vague = calibrate(
            *streams, reference="B10", prior={"z": (0.0, 100.0)}, checks=False
        )
        assert_allclose(vague.T_parent_child, plain.T_parent_child, atol=1e-5)
        assert [dof.verdict for dof in vague.observability] == [
            dof.verdict for dof in plain.observability
        ]

    @pytest.mark.parametrize(
        ("axis", "prior"),
        [
            ("x", (-0.6, 0.001)),
            ("x", "100m+/-1e-9m"),
            ("z", "15m+/-0.05m"),
            ("yaw", (0.2, 0.01)),
        ],
    )
    def test_a_contradiction_is_refused_and_the_prior_left_out(
        self, wandering, axis, prior
    ):
        streams, plain = wandering
        result = calibrate(*streams, reference="B10", prior={axis: prior})
        assert result.status is SolveStatus.CONTRADICTED
        assert result.status.failure == "a prior contradicts the motion"
        assert result.verdict is Verdict.DO_NOT_USE
        assert result.reasons[0].sentence.startswith(f"the prior on {axis} is ")
        assert (
            result.reasons[0].advice
            == f"check value, unit and sign of prior.{axis}"
        )
        assert_array_equal(result.T_parent_child, plain.T_parent_child)
        assert_array_equal(
            result.covariance_measured, plain.covariance_measured
        )


@pytest.mark.parametrize("interface", ["Python", "command", "YAML", "page"])
def test_centimetres_that_were_typed_without_a_unit_are_asked_about(
    interface, tmp_path, capsys
):
    paths = motions.write_pair(tmp_path, *flat_drive())
    expected = "prior.z needs a unit: -22"
    if interface == "Python":
        with pytest.raises(ConfigError, match=expected):
            calibrate(*flat_drive(), prior={"z": (-22.0, 2.0)})
        return
    if interface == "page":
        with pytest.raises(ConfigError, match=expected):
            CalibratorConfig(prior_z=prior_as_typed("z", "-22", "2"))
        assert prior_as_typed("z", "-22 ", "2cm") == "-22+/-2cm"
        assert prior_as_typed("z", "-0,22", "0.02") == "-0.22m+/-0.02m"
        assert prior_as_typed("z", "8m", "0.02") == "8m+/-0.02m"
        assert prior_as_typed("yaw", "-90", "2") == "-90deg+/-2deg"
        return
    options = ["--prior", "z=-22+/-2"]
    if interface == "YAML":
        file = tmp_path / "options.yaml"
        file.write_text("prior.z: -22+/-2\n", encoding="utf-8")
        options = ["--config", str(file)]
    try:
        status = main(
            ["calibrate", *paths, *options, "--out", str(tmp_path / "out")]
        )
    except SystemExit as usage:
        status = usage.code
    assert status == 2
    error = capsys.readouterr().err
    assert (
        "needs a unit: -22 may be m, cm or mm; write -22cm+/-2cm or -22m+/-2m"
        in error
    )
    assert not (tmp_path / "out").exists()


def test_along_an_unobservable_axis_only_an_impossible_distance_contradicts():
    # A boom of 15 m is longer than "unknown" assumes, and the motion says nothing about it.
    parent, child = flat_drive()
    boom = {"z": "15m+/-0.05m"}
    in_millimetres = {"z": "1850m+/-20m"}

    result = calibrate(parent, child, reference="B10", prior=boom)
    contradicted = calibrate(
        parent, child, reference="B10", prior=in_millimetres
    )

    assert result.status is SolveStatus.OK
    assert result.T_parent_child[2, 3] == pytest.approx(15.0, abs=0.05)
    assert contradicted.status is SolveStatus.CONTRADICTED
    assert contradicted.unobservable() == ["z"]


def test_the_command_refuses_a_contradiction(tmp_path, capsys):
    paths = motions.write_pair(tmp_path, *flat_drive())
    frames = ["--parent-frame", "lidar", "--child-frame", "camera"]
    command = [
        "calibrate",
        *paths,
        *frames,
        "--reference",
        "B10",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--prior", "x=100m+/-1e-9m"]) == 1
    captured = capsys.readouterr()
    assert "the prior on x is " in captured.err
    assert captured.out.startswith("DO NOT USE: the prior on x is ")
    assert "static_transform" not in captured.out
    assert load_result(tmp_path / "out").status is SolveStatus.CONTRADICTED
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["extrinsic.yaml", "report.html"]
