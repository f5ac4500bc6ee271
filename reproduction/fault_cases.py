"""Faults that give a wrong extrinsic in confidence, made on purpose in two streams, each in three
severities. The limits of the checks were set with the first group; the others were built later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hand_eye_calib.geometry.trajectory import Trajectory
from reproduction import damage
from reproduction.damage import Random, Streams


@dataclass(frozen=True)
class Fault:
    """A fault: its code, and what is wrong in words."""

    code: str
    what: str
    # The weakest first; one if it has no degrees.
    severities: tuple[float, ...]
    unit: str
    # ``damage(parent, child, severity, generator)``.
    damage: Callable[[Trajectory, Trajectory, float, Random], Streams]
    # Codes of findings that name it.
    named: frozenset[str] = frozenset({"*"})
    # Of the calibration, besides its method.
    options: Mapping[str, Any] = field(default_factory=dict)


def _of_child(
    code: str,
    what: str,
    severities: tuple[float, ...],
    unit: str,
    change: Callable[[Trajectory, float, Random], Trajectory],
    named: str = "*",
    **options: Any,
) -> Fault:
    """A fault of the child's stream alone; ``named`` has the codes, a space between them."""
    return Fault(
        code, what, severities, unit,
        lambda parent, child, value, random: (parent, change(child, value, random)),
        frozenset(named.split()), options,
    )  # fmt: skip


_POSITIONS = "smoothed_positions position_clock"
_WHICH = (0.0, 1.0, 2.0)
_FLAT = "flat unrelated noisy"

FAULTS = (
    Fault(
        "S1", "child is the parent's own frame", (0.01, 0.003, 0.0), "m noise", damage.copied,
        frozenset({"same_frame"}),
    ),
    Fault(
        "S2", "child positions from the parent", (0.01, 0.003, 0.0), "m noise", damage.fused,
        frozenset({"same_position", "same_frame"}),
    ),
    _of_child(
        "S3", "two sensors, one world", (0.03, 0.1, 0.3), "m",
        damage.interleaved, "interleaved",
    ),
    _of_child(
        "S3b", "two sensors, two worlds", (0.1, 0.3, 3.0), "m", damage.in_two_worlds, "interleaved"
    ),
    _of_child(
        "S4", "positions low-passed", (0.05, 0.1, 0.2), "s",
        damage.low_passed, _POSITIONS,
    ),
    _of_child(
        "S4b", "positions late", (0.05, 0.1, 0.2), "s",
        damage.late_positions, _POSITIONS,
    ),
    _of_child(
        "S5", "positions smoothed, no delay", (0.05, 0.1, 0.2), "s", damage.smoothed, _POSITIONS
    ),
    _of_child(
        "S6", "all low-passed", (0.05, 0.1, 0.2), "s",
        lambda child, s, _: damage.with_parts(
            child, damage.filtered_rotations(child, s), damage.filtered_positions(child, s)
        ),
        f"smoothed_orientations {_POSITIONS}", time_offset="estimate",
    ),
    _of_child("S7", "yaw gain", (0.005, 0.01, 0.02), "", damage.yaw_gain, "rotation_gain"),
    _of_child(
        "S8", "mount loosened half-way", (0.5, 1.0, 2.0), "deg", damage.loosened, "mount_moved"
    ),
    _of_child(
        "S9", "scale", (0.005, 0.01, 0.02), "",
        lambda child, excess, _: child.scaled(1.0 + excess), "scale",
    ),
    _of_child("S10", "mirrored axis", _WHICH, "(axis)", damage.mirrored, "axes left_handed"),
    _of_child(
        "S10b", "child in 2D", (0.5, 0.8, 1.0), "share",
        lambda child, share, _: damage.higher(damage.upright(child, share), 1.0 - share), _FLAT,
    ),
    Fault(
        "S11", "float32 positions", (2e3, 5e4, 5e5), "m east", damage.as_float32,
        frozenset({"coarse_positions"}),
    ),
    Fault(
        "S12", "both scalar first", (0.0,), "", damage.scalar_first, frozenset({"quaternion_order"})
    ),
    _of_child(
        "S13", "inverse poses under noise", (0.003, 0.02, 0.05), "m noise", damage.inverted,
        "inverse",
    ),
    _of_child(
        "S14", "orientations inverted", (0.0, 0.01, 0.03), "m noise", damage.inverted_orientations,
        "inverse_orientation",
    ),
    _of_child(
        "clock", "child's clock", (0.02, 0.05, 0.2), "s",
        lambda child, s, _: child.shifted(s), "time_offset",
    ),
    _of_child("S15", "jumps", (0.003, 0.01, 0.03), "share", damage.jumping, "jumps"),
)  # fmt: skip
UNTUNED = (
    _of_child(
        "U1", "orientations with yaw only", (0.2, 0.5, 1.0), "share",
        lambda child, share, _: damage.upright(child, share),
    ),
    _of_child("U2", "coarse stamps", (0.01, 0.05, 0.1), "s", damage.rounded_stamps),
    _of_child("U3", "part of the child repeated", (0.1, 0.25, 0.5), "share", damage.repeated),
    _of_child("U4", "child restarted half-way", (0.0, 1.0, 10.0), "s gap", damage.restarted),
    _of_child("U5", "quaternion with one wrong sign", _WHICH, "(part)", damage.flipped),
    _of_child("U6", "latency that grows", (0.02, 0.05, 0.2), "s", damage.slow_clock),
    Fault("U7", "parent's orientations smoothed", (0.05, 0.1, 0.2), "s", damage.smooth_parent),
    _of_child(
        "U8", "another unit", (100.0, 1000.0, 3.28084), "",
        lambda child, factor, _: child.scaled(factor),
    ),
    _of_child("U9", "degrees read as radians", _WHICH, "(which)", damage.degrees_as_radians),
    Fault("U10", "two recordings, remounted", (1.0, 2.0, 5.0), "deg", damage.remounted),
    _of_child("U11", "poses held", (0.1, 0.2, 0.5), "s", damage.held),
    _of_child(
        "U12", "two sensors, no order", (0.03, 0.1, 0.3), "m",
        lambda child, metres, random: damage.moved_at(
            child, random.random(len(child)) < 0.5, damage.beside(metres)
        ),
    ),
)  # fmt: skip
UNSEEN = (
    Fault(
        "V1", "parent's positions late", (0.02, 0.05, 0.1), "s",
        lambda parent, child, s, random: (damage.late_positions(parent, s, random), child),
    ),
    _of_child(
        "V2", "child's orientations late", (0.02, 0.05, 0.1), "s",
        lambda child, s, _: damage.with_parts(child, damage.delayed(child, s)[:, :3, :3]),
    ),
    _of_child(
        "V3", "heights off by a factor", (0.02, 0.1, 0.5), "",
        lambda child, gain, _: damage.higher(child, 1.0 + gain),
    ),
    _of_child("V4", "heading drifts", (1.0, 5.0, 20.0), "deg/min", damage.heading_drift),
    _of_child(
        "V5", "positions flat", (0.2, 0.5, 1.0), "share",
        lambda child, share, _: damage.higher(child, 1.0 - share),
    ),
    _of_child("V6", "stamps scatter", (0.005, 0.02, 0.05), "s", damage.jittered),
    _of_child("V7", "every second stamp late", (0.01, 0.02, 0.04), "s", damage.every_second_late),
    _of_child("V8", "child swings on its mount", (0.2, 1.0, 5.0), "deg", damage.swinging),
    _of_child("V9", "angles in whole steps", (0.2, 1.0, 5.0), "deg", damage.coarse_angles),
    Fault(
        "V10", "both streams' positions low-passed", (0.05, 0.1, 0.2), "s",
        lambda parent, child, s, random: (
            damage.low_passed(parent, s, random), damage.low_passed(child, s, random)
        ),
    ),
)  # fmt: skip
LAST = (
    _of_child("W1", "filled up by interpolation", (2.0, 4.0, 8.0), "times", damage.interpolated),
    _of_child("W2", "left-handed axes", _WHICH, "(axis)", damage.mirrored_world),
    _of_child("W3", "stuck half-way", (2.0, 5.0, 15.0), "s", damage.stuck),
    _of_child("W4", "few digits", (3.0, 2.0, 1.0), "digits", damage.few_digits),
    _of_child("W5", "relocalised every 20 s", (0.1, 0.5, 2.0), "m", damage.relocalised),
    _of_child("W6", "published again", (0.005, 0.02, 0.05), "s later", damage.republished),
    _of_child("W7", "clock too fast", (100.0, 1000.0, 5000.0), "ppm", damage.fast_clock),
    Fault("W8", "heights zero", _WHICH, "(which)", damage.heightless),
    _of_child("W9", "heading low-passed", (0.05, 0.1, 0.3), "s", damage.slow_heading),
    _of_child("W10", "stamps of arrival, in bursts", (0.1, 0.3, 1.0), "s", damage.in_bursts),
)  # fmt: skip

SILENT = (
    _of_child(
        "X1", "positions turned against orientations", (1.5, 2.5, 4.0), "deg",
        damage.turned_positions, "worlds_turned",
    ),
    Fault(
        "X2", "the parent's turned", (1.5, 2.5, 4.0), "deg",
        lambda parent, child, degrees, random: (
            damage.turned_positions(parent, degrees, random), child
        ),
        frozenset({"worlds_turned"}),
    ),
    _of_child(
        "X3", "heights in another unit", (1.02, 1.1, 3.28084), "",
        lambda child, factor, _: damage.higher(child, factor), "axis_scale",
    ),
    _of_child(
        "X4", "heights of a barometer", (0.3, 1.0, 3.0), "s",
        damage.late_heights, "axis_lag axis_scale",
    ),
    _of_child(
        "X5", "heights constant", (0.0,), "",
        lambda child, factor, _: damage.higher(child, factor), "constant_coordinate",
    ),
)  # fmt: skip

# Groups of the page: title to faults.
GROUPS = {
    "Faults": FAULTS,
    "Twelve faults that were built without a limit for them": UNTUNED,
    "Ten faults that were built after those": UNSEEN,
    "Ten faults that were built when all was done, as they came": LAST,
    "Five faults that were silent before their columns": SILENT,
}
