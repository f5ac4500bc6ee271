"""Checks of streams that have only positions, rotations or rates: faults made on purpose."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.partial.position_columns import posterior_smoothing
from reproduction import part_faults
from reproduction.coverage import classes
from reproduction.platforms import PLATFORMS

SEED = 31


@cache
def solved(kind, fault, platform):
    make, _ = part_faults.KINDS[kind]
    recording = make(platform, fault, SEED)
    return hec.calibrate(recording.parent, recording.child, **part_faults.WIDE)


def codes(result, severity="error"):
    return [
        finding.code
        for finding in result.findings
        if finding.severity.value == severity
    ]


# Kind, fault, and the finding that names it.
NAMED = [
    ("positions", "copied", "same_position"),
    ("positions", "copied with noise", "same_position"),
    ("positions", "copied, resampled", "same_position"),
    ("positions", "copied, world turned", "same_position"),
    ("positions", "computed with a wrong lever arm", "not_independent"),
    ("positions", "1 Hz interpolated", "interpolated"),
    ("positions", "Web Mercator", "scale"),
    ("positions", "scale 1.05", "scale"),
    ("positions", "height in feet", "axis_scale"),
    ("rates", "own rates", "same_frame"),
    ("rates", "mount moved 2 deg", "mount_moved"),
]


@pytest.mark.parametrize(("kind", "fault", "code"), NAMED)
def test_a_fault_of_a_part_of_the_poses_is_named_and_never_to_be_used(
    kind, fault, code
):
    result = solved(kind, fault, "drone")
    assert code in codes(result)
    assert result.verdict is hec.Verdict.DO_NOT_USE


# Faults of a path, and the code of the finding on machines that move in other ways.
OF_THE_PATH = [
    ("low-passed 200 ms", "smoothed_positions", ["hand", "agv", "drone"]),
    ("smoothed 250 ms", "smoothed_positions", ["car", "drone_slam", "agv"]),
    ("constant height", "axis_scale", ["hand", "agv"]),
    ("height in feet", "axis_scale", ["excavator", "agv"]),
    ("height 300 ms late", "axis_lag", ["hand", "car"]),
]


@pytest.mark.parametrize(
    ("fault", "code", "platform"),
    [
        (fault, code, platform)
        for fault, code, names in OF_THE_PATH
        for platform in names
    ],
)
def test_a_fault_of_the_path_is_named_and_its_error_is_within_sigma(
    fault, code, platform
):
    result = solved("positions", fault, platform)
    assert code in [*codes(result), *codes(result, "warning")]
    assert result.verdict is not hec.Verdict.USE
    truth = part_faults.positions(platform, fault, SEED).truth
    assert part_faults.largest_ratio("positions", result, truth) < 2.5


@pytest.mark.parametrize("platform", ["hand", "drone"])
def test_a_delay_of_positions_is_estimated(platform):
    result = solved("positions", "delayed 150 ms", platform)
    assert codes(result) == []
    assert result.time_offset_s == pytest.approx(-0.15, abs=0.02)


def test_a_delay_is_estimated_although_a_lever_arm_hides_it_in_the_speeds():
    recording = part_faults.positions("hand", "delayed 150 ms", 831500)
    result = hec.calibrate(
        recording.parent, recording.child, **part_faults.WIDE
    )
    assert result.findings == ()
    assert result.time_offset_s == pytest.approx(-0.15, abs=0.005)


def test_positions_too_few_to_detect_smoothing_are_to_be_used_with_care():
    recording = part_faults.positions("drone", "clean", SEED)
    short = recording.child[: len(recording.child) // 16]
    result = hec.calibrate(recording.parent, short, **part_faults.WIDE)
    assert "unchecked" in codes(result, "warning")
    assert result.verdict is not hec.Verdict.USE


def test_the_posterior_of_smoothing_lies_between_zero_and_the_estimate():
    clear = posterior_smoothing(0.02, 0.001)
    assert clear.mean_s2 == pytest.approx(0.02, rel=0.02)
    assert clear.variance_s4**0.5 == pytest.approx(0.001, rel=0.02)
    vague = posterior_smoothing(0.02, 0.2)
    assert abs(vague.mean_s2) < 0.0002
    # Without information, the variance is that of the prior: 80 % of 2e-3, 20 % of 1e-2.
    prior_s4 = 0.8 * 0.002**2 + 0.2 * 0.01**2
    assert vague.variance_s4 == pytest.approx(prior_s4, rel=0.05)
    assert posterior_smoothing(-0.02, 0.001).mean_s2 == pytest.approx(
        -clear.mean_s2
    )


def test_smoothing_that_is_too_weak_for_a_finding_is_removed_from_the_lever_arm():
    recording = part_faults.positions("drone_slam", "clean", SEED)
    path = recording.child.poses[:, :3, 3]
    smoothed = gaussian_filter1d(
        path, 2.0, axis=0, mode="nearest"
    )  # 0.1 s, 5e-3 s^2
    child = Trajectory.from_positions(
        recording.child.stamps_ns, smoothed, "antenna", "map"
    )
    result = hec.calibrate(recording.parent, child, **part_faults.WIDE)
    assert codes(result) == []
    assert part_faults.largest_ratio("positions", result, recording.truth) < 2.5
    # The smoothing shifts the lever arm along z by 5 cm.
    assert result.T_parent_child[2, 3] == pytest.approx(
        recording.truth[2], abs=0.03
    )


# Faults of rates and rotations, and the code of the finding on machines that move in other ways.
OF_ROTATIONS = [
    ("rates", "axis misaligned 3 deg", "misaligned", ["drone", "agv"]),
    ("rates", "gain of an axis 1.03", "rotation_gain", ["car"]),
    ("rates", "low-passed 200 ms", "smoothed_rates", ["hand"]),
    ("rates", "smoothed 250 ms", "smoothed_rates", ["agv"]),
    ("rates", "copied, turned", "not_independent", ["drone"]),
    ("rates", "clipped", "clipped_rates", ["drone"]),
    ("rates", "steps of 2 deg/s", "coarse_rates", ["hand"]),
    ("rates", "bias walks", "bias_drift", ["car"]),
    ("rates", "degrees", "rate_unit", ["hand"]),
    ("rates", "two axes swapped", "left_handed", ["hand", "car"]),
    ("rates", "sign of an axis", "left_handed", ["drone"]),
    ("rotations", "copied, turned", "not_independent", ["car"]),
    ("rotations", "low-passed 200 ms", "smoothed_orientations", ["drone"]),
    ("rotations", "smoothed 250 ms", "smoothed_orientations", ["car"]),
    ("rotations", "mount moved 2 deg", "mount_moved", ["agv"]),
    ("rotations", "inverse", "inverse_orientation", ["car"]),
    ("rotations", "order w x y z", "inverse_orientation", ["drone"]),
    ("rotations", "yaw only", "flat", ["drone"]),
    ("rotations", "yaw gain 1.05", "rotation_gain", ["hand", "car"]),
    ("rotations", "steps of 1 deg", "coarse_orientations", ["drone"]),
]


@pytest.mark.parametrize(
    ("kind", "fault", "code", "platform"),
    [
        (kind, fault, code, platform)
        for kind, fault, code, names in OF_ROTATIONS
        for platform in names
    ],
)
def test_a_fault_of_rotations_is_named_and_its_error_is_within_sigma(
    kind, fault, code, platform
):
    result = solved(kind, fault, platform)
    assert code in [*codes(result), *codes(result, "warning")]
    assert result.verdict is not hec.Verdict.USE
    if result.verdict is hec.Verdict.USE_WITH_CARE:
        truth = part_faults.KINDS[kind][0](platform, fault, SEED).truth
        assert part_faults.largest_ratio(kind, result, truth) < 2.5


@pytest.mark.parametrize("platform", PLATFORMS)
def test_clean_positions_have_no_finding_and_may_be_used(platform):
    result = solved("positions", "clean", platform)
    assert codes(result) == []
    assert codes(result, "warning") == []
    assert result.verdict is hec.Verdict.USE


@pytest.mark.parametrize("kind", ["rates", "rotations"])
@pytest.mark.parametrize("platform", PLATFORMS)
def test_clean_rotations_have_no_finding_and_may_be_used(kind, platform):
    result = solved(kind, "clean", platform)
    assert codes(result) == []
    assert codes(result, "warning") == []
    assert result.verdict is hec.Verdict.USE


@pytest.mark.parametrize("stream", ["parent", "child"])
def test_a_fault_names_the_stream_that_has_positions(stream):
    recording = part_faults.positions("drone", "height in feet", SEED)
    streams = (recording.parent, recording.child)
    result = hec.calibrate(
        *(streams if stream == "child" else streams[::-1]), **part_faults.WIDE
    )
    (finding,) = [item for item in result.findings if item.code == "axis_scale"]
    assert finding.stream == stream
    assert f"the {stream} stream's z coordinates" in finding.what


@pytest.mark.parametrize("scale", ["none", 1.0 / 1.05])
def test_a_scale_that_was_given_is_no_error(scale):
    recording = part_faults.positions("drone", "scale 1.05", SEED)
    result = hec.calibrate(
        recording.parent, recording.child, scale=scale, **part_faults.WIDE
    )
    assert "scale" not in codes(result)


@pytest.mark.parametrize("scale", ["estimate", "auto"])
def test_a_scale_that_was_asked_for_is_obeyed(scale):
    recording = part_faults.positions("drone", "scale 1.05", SEED)
    result = hec.calibrate(
        recording.parent, recording.child, scale=scale, **part_faults.WIDE
    )
    assert abs(result.scale - 1.0 / 1.05) < 4.0 * result.scale_sigma < 0.01
    assert "scale" not in codes(result)


def test_auto_leaves_a_scale_that_is_one():
    recording = part_faults.positions("drone", "clean", SEED)
    result = hec.calibrate(
        recording.parent, recording.child, scale="auto", **part_faults.WIDE
    )
    assert result.scale == pytest.approx(1.0, abs=0.005)


def test_parallel_axes_and_an_antenna_at_the_origin_may_be_said_by_priors():
    rates = part_faults.rates("drone", "own rates", SEED)
    priors = {axis: (0.0, np.radians(2.0)) for axis in ("roll", "pitch", "yaw")}
    result = hec.calibrate(
        rates.parent, rates.child, prior=priors, **part_faults.WIDE
    )
    assert codes(result) == []
    positions = part_faults.positions("drone", "copied with noise", SEED)
    here = dict.fromkeys("xyz", (0.0, 0.02))
    result = hec.calibrate(
        positions.parent, positions.child, prior=here, **part_faults.WIDE
    )
    assert "same_position" not in codes(result)


@pytest.mark.parametrize(
    ("turned_rad", "noise_rad", "code", "severity"),
    [
        (0.0, 0.0, "same_frame", "error"),
        (0.7, 0.0, "not_independent", "error"),
        (0.0, 0.002, "same_frame", "warning"),
    ],
)
def test_orientations_alone_of_the_parent_itself_are_named(
    turned_rad, noise_rad, code, severity
):
    parent = part_faults.rates("drone", "clean", SEED).parent
    noise = noise_rad * np.random.default_rng(2).standard_normal(
        (len(parent), 3)
    )
    turns = se3.rotation_exp(noise) @ se3.rotation_exp([0.0, turned_rad, 0.0])
    poses = parent.poses @ se3.from_rotation_translation(turns, np.zeros(3))
    own = dataclasses.replace(
        parent, poses=poses, measures="rotations", sensor_frame="imu"
    )
    result = hec.calibrate(parent, own, **part_faults.WIDE)
    assert code in codes(result, severity)
    assert result.verdict is not hec.Verdict.USE


def test_rotations_about_one_axis_are_not_mirrored_by_the_noise_of_the_others():
    stamps_ns = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(1200)
    random = np.random.default_rng(4)
    yaw = 0.8 * np.sin(0.05 * np.arange(1200))
    noise = 0.002 * random.standard_normal((1200, 3))
    turns = se3.rotation_exp(np.column_stack([noise[:, :2], yaw]))
    opposite = se3.rotation_exp(
        np.column_stack([noise[:, 0], -noise[:, 1], yaw])
    )
    parent = Trajectory(
        stamps_ns, se3.from_rotation_translation(turns, np.zeros(3)), "ins"
    )
    child = Trajectory(
        stamps_ns, se3.from_rotation_translation(opposite, np.zeros(3)), "imu"
    )
    result = hec.calibrate(
        parent, dataclasses.replace(child, measures="rotations")
    )
    assert "left_handed" not in codes(result)


def test_positions_of_a_short_recording_do_not_end_in_a_traceback():
    stamps_ns = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(40)
    turns = np.random.default_rng(0).standard_normal((40, 6)) * 0.3
    poses = se3.exp(turns)
    parent = Trajectory(stamps_ns, poses, "lidar")
    child = Trajectory.from_positions(
        stamps_ns, poses[:, :3, :3] @ [0.3, 0.1, 0.2], "antenna"
    )
    result = hec.calibrate(parent, child)
    assert result.verdict is not hec.Verdict.USE


def test_rates_on_a_flat_floor_are_good_to_the_usual_misalignment():
    """About one axis, a misaligned gyroscope looks like a turned one: 0.5 deg is usual."""
    drive = classes.make("flat_agv", 931)
    steps = se3.log(
        se3.inverse(drive.child.poses[:-1]) @ drive.child.poses[1:]
    )[:, 3:]
    stamps_ns = drive.child.stamps_ns
    rates = steps / (np.diff(stamps_ns)[:, None] * 1e-9)
    rates += 0.001 * np.random.default_rng(SEED).standard_normal(rates.shape)
    middles_ns = (stamps_ns[:-1] + stamps_ns[1:]) // 2
    result = hec.calibrate(
        drive.parent, Trajectory.from_rates(middles_ns, rates)
    )
    assert 0.3 < np.degrees(result.sigmas[3]) < 3.0
    assert not np.isfinite(result.sigmas[5])
