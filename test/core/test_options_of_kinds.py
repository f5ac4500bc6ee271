"""Every option of the engine is obeyed or refused, whatever the streams measure."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.fleet.together import calibrate_together
from hand_eye_calib.extras.rig.rig import calibrate_rig
from hand_eye_calib.extras.stops.calibrate import calibrate_stops

KINDS = ("poses", "positions", "rotations", "rates", "stops", "rig", "together")

# A value of each option that is not the default and that matters for the streams below.
VALUES = {
    "method": "dnl",
    "reference": "B3",
    "backend": "ipopt",
    "threshold": 1e-5,
    "min_inlier_fraction": 0.999,
    "min_pairs": 1000,
    "max_pairs": 100,
    "keyframe.min_translation": 1.0,
    "keyframe.min_rotation": 0.3,
    "keyframe.min_interval": 0.25,
    "max_gap": 0.01,
    "time_offset": 0.02,
    "scale": 1.1,
    "parent_scale": 2.0,
    "parent_measures": "rotations",
    "child_measures": "rotations",
    "parent_invert": "poses",
    "child_invert": "orientations",
    "parent_quaternion": "wxyz",
    "child_quaternion": "wxyz",
    "parent_kind": "exact",
    "child_kind": "exact",
    "nominal_radius": 0.1,
    "nominal_separation": 0.5,
    "prior.x": "1+/-0.1",
    "prior.y": "1+/-0.1",
    "prior.z": "1+/-0.1",
    "prior.roll": "0.1+/-0.2",
    "prior.pitch": "0.1+/-0.2",
    "prior.yaw": "0.1+/-0.2",
    "target.translation": 1e-3,
    "target.rotation": 1e-4,
    "target.axes": "z=10cm",
    "parent_frame": "lidar",
    "child_frame": "camera",
}

# Options that a kind of streams refuses: of wheels, of methods of the paper, of lengths, of
# orientations.
_OF_WHEELS = {"nominal_radius", "nominal_separation"}
_OF_WHOLE_POSES = {
    "method",
    "reference",
    "backend",
    "threshold",
    "min_inlier_fraction",
}
REFUSED = {
    "poses": set(),
    "positions": {"parent_measures", "child_invert", "child_quaternion"}
    | _OF_WHOLE_POSES,
    "rotations": {"scale", "parent_scale"} | _OF_WHOLE_POSES,
    "rates": {"scale", "parent_scale", "child_invert", "child_quaternion"}
    | _OF_WHOLE_POSES,
    "stops": {"max_pairs", "max_gap", "time_offset"}
    | {
        "keyframe.min_translation",
        "keyframe.min_rotation",
        "keyframe.min_interval",
    }
    | {"parent_kind", "child_kind"}
    | _OF_WHOLE_POSES,
    "rig": {"time_offset", "scale"}
    | {
        name
        for name in VALUES
        if name.startswith(("parent_", "child_", "prior."))
        and not name.endswith("_kind")
    },
    "together": set(),
}

# What a stream measures already changes nothing.
SAME = {("rotations", "parent_measures"), ("rotations", "child_measures")}
SAME |= {("rates", "parent_measures")}

# Options of one method of the paper are tried with that method.
_OF_DNLO = ("threshold", "min_inlier_fraction", "backend")


@cache
def streams(kind):
    """Noisy streams whose stamps differ by half an interval; the child has outliers."""
    poses = wandering_poses(240)
    turn = se3.exp(np.array([0, 0, 0, 0.5, 0, 0]))
    child_poses = disturbed(child_of(poses), 1, 0.002, 0.001)
    child_poses[50::60, :3, 3] += 0.5
    child_poses[50::60] = child_poses[50::60] @ turn
    parent = as_trajectory(disturbed(poses, 4, 0.002, 0.001))
    child = as_trajectory(child_poses).shifted(parent.interval_s / 2)

    if kind == "positions":
        positions = child.poses[:, :3, 3]
        child = Trajectory.from_positions(child.stamps_ns, positions)
    elif kind == "rotations":
        child = replace(child, measures="rotations")
    elif kind == "rates":
        steps = se3.inverse(child.poses[:-1]) @ child.poses[1:]
        turns = se3.log(steps)[:, 3:]
        seconds = np.diff(child.stamps_ns)[:, None] * 1e-9
        child = Trajectory.from_rates(child.stamps_ns[1:], turns / seconds)
    return parent, child


@cache
def stops():
    """Poses of both sensors at 40 stops."""
    poses = wandering_poses(240)[::6]
    return disturbed(poses, 4, 0.002, 0.001), disturbed(
        child_of(poses), 1, 0.002, 0.001
    )


@cache
def sensors():
    """Noisy streams of three sensors of a rig."""
    parent, child = streams("poses")
    other = child_of(wandering_poses(240)) @ se3.exp(
        np.array([0.2, 0.1, 0, 0, 0, 0.3])
    )
    return {
        "lidar": parent,
        "camera": child,
        "rear": as_trajectory(disturbed(other, 2, 0.002, 0.001)),
    }


def joint_result(options):
    """Return the result of both halves of a recording, as two recordings of one rig."""
    fields = {}
    prior = {}
    for option, value in options.items():
        if option.startswith("prior."):
            prior[option.removeprefix("prior.")] = value
        else:
            fields[option.replace(".", "_")] = value
    parent, child = streams("poses")
    halves = [(parent[:120], child), (parent[120:], child)]
    return calibrate_together(halves, **fields, prior=prior, checks=False)


@cache
def document(kind, **options):
    try:
        if kind == "stops":
            result = calibrate_stops(
                *stops(), CalibratorConfig.from_options(options)
            )
        elif kind == "rig":
            result = calibrate_rig(sensors(), options)
        elif kind == "together":
            result = joint_result(options)
        else:
            result = whole_snapshot(*streams(kind), options).estimate()
    except InputError as error:
        return str(error)
    return str(result.to_dict())


def test_the_table_has_every_option():
    defaults = CalibratorConfig()
    assert set(VALUES) == set(defaults.to_options())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("option", VALUES)
def test_an_option_is_obeyed_or_refused(option, kind):
    has_methods = kind in ("poses", "rig", "together")
    other_options = {}
    if has_methods and option in _OF_DNLO:
        other_options = {"method": "dnlo", "reference": "B3"}
    options = {**other_options, option: VALUES[option]}
    if option in REFUSED[kind] | _OF_WHEELS:
        dotted = option.replace("_", ".")
        with pytest.raises(ConfigError, match=dotted):
            document(kind, **options)
        return

    with_option = document(kind, **options)
    without_option = document(kind, **other_options)

    is_ignored = with_option == without_option
    assert is_ignored == ((kind, option) in SAME)
