"""Extrinsics in the files of other programs, whose layouts are in ``layouts.yaml``.

Which way round a transform goes is what people get wrong most often. So each file says by the names
of the frames what its numbers map, and whether the calibration was inverted for it. Where the
directions come from is in docs/exports.md.
"""

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import ConfigError, InputError, printable
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import Judged, Verdict

# Beginnings of the words in a frame's name that say what the sensor is; nearest to the body first,
# as the parent is taken for nearer than the child if the names say nothing.
_ROLES = {
    "base": ("base", "ego", "vehicle", "chassis", "rig", "hand", "tool", "flange"),
    "imu": ("imu", "body", "gyro", "ins", "novatel", "xsens"),
    "lidar": ("lidar", "velo", "ouster", "livox", "laser", "hesai", "pandar", "rslidar", "scan"),
    "camera": ("cam", "image", "optical", "rgb", "stereo", "realsense", "zed", "vio", "vision"),
    "gnss": ("gnss", "gps", "antenna", "rtk"),
}
_RANKS = {role: rank for rank, role in enumerate(_ROLES)}
# Decimals of what is written: a thousandth of a micrometre.
_DECIMALS = 12
# What PX4 accepts for a delay (ms).
_LONGEST_DELAY_MS = 300.0


class Layout(NamedTuple):
    """How a format writes one pair of sensors: the numbers are ``T_target_source``.

    Attributes
    ----------
    target, source : str
        What the sensors are; empty for any.
    is_inverted : bool or None
        Whether the target is the child; None if both are possible.
    keys : sequence of str
        What a reader looks for: a pose, or translation and rotation.
    text : str
        The file, with ``%(name)s`` where numbers and names go.
    clock : int
        ``t_target = t_source + clock * shift``; 0 if the file has no shift.
    axes : sequence of str
        Axes that must be known.
    axes_said : str
        What the file says of its axes.
    """

    target: str = ""
    source: str = ""
    is_inverted: bool | None = None
    keys: Sequence[str] = ()
    text: str = ""
    clock: int = 0
    axes: Sequence[str] = AXES
    axes_said: str = ""


@cache
def formats() -> dict[str, list[Layout]]:
    """The layouts of each format."""
    text = Path(__file__).with_name("layouts.yaml").read_text(encoding="utf-8")
    rows = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {name: [Layout(**each) for each in found] for name, found in rows.items()}


def role_of(frame: str) -> str:
    """What a sensor is, by the name of its frame; empty if it does not say."""
    words = re.findall("[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", frame).lower())
    found = [
        role for role, starts in _ROLES.items() if any(word.startswith(starts) for word in words)
    ]
    # camera_base_link is a camera's, imu_link of the base an IMU's.
    return next((role for role in found if role != "base"), found[0] if found else "")


def arranged(
    layouts: Sequence[Layout], parent_frame: str, child_frame: str
) -> tuple[Layout, bool, bool]:
    """The layout that fits the sensors best, whether its numbers are ``T_child_parent``, and
    whether the names of the frames say so.
    """
    roles = (role_of(parent_frame), role_of(child_frame))
    found = []
    for order, layout in enumerate(layouts):
        ways = (False, True) if layout.is_inverted is None else (layout.is_inverted,)
        for is_inverted in ways:
            wanted = (layout.source, layout.target) if is_inverted else layout[:2]
            matches = sum(one == role != "" for one, role in zip(wanted, roles, strict=True))
            misses = sum(one not in ("", role) for one, role in zip(wanted, roles, strict=True))
            is_natural = _RANKS.get(wanted[0], 0) <= _RANKS.get(wanted[1], 0)
            fit = layout, is_inverted, not misses
            found.append((matches, -misses, -order, is_natural, fit))
    return max(found, key=lambda each: each[:4])[4]


def export_text(result: Judged, name: str) -> str:
    """A calibration in the format of another program, unless it is not usable. See
    :meth:`~hand_eye_calib.core.results.calibration.Calibration.export`.
    """
    if name not in formats():
        raise ConfigError(f"unknown format {name!r}; known are {', '.join(formats())}")
    if result.verdict is Verdict.DO_NOT_USE:
        raise InputError(f"nothing is written: {result.headline}")
    frames = (result.parent_frame, result.child_frame)
    T = result.T_parent_child
    layout, is_inverted, is_certain = arranged(formats()[name], *frames)
    if layout.is_inverted is False and not layout.target:  # the vehicle or robot, if it is known
        frames = (result.mounting[0], result.child_frame)
        T = result.mounting[1]
    if unknown := [axis for axis in result.unobservable() if axis in layout.axes]:
        raise InputError(
            f"nothing is written: this recording does not determine {axes_in_words(unknown)}; "
            "measure it by hand and calibrate again with --prior"
        )
    target, source = frames[::-1] if is_inverted else frames
    shift_s = layout.clock * (-1 if is_inverted else 1) * result.time_offset_s
    texts = _numbers(se3.inverse(T) if is_inverted else T)
    texts |= {"target": json.dumps(target), "source": json.dumps(source), "shift": _number(shift_s)}
    is_fixed = "base" in target.lower()  # a camera beside the robot, not on its hand
    texts |= {"eye": "eye_on_base" if is_fixed else "eye_in_hand", "robot": '"base"'}
    texts |= {"effector": '"hand"', ("robot" if is_fixed else "effector"): texts["target"]}
    delay_ms = -1e3 * result.time_offset_s
    texts["ev_delay"] = f"param set EKF2_EV_DELAY {_number(round(delay_ms, 3))}"
    if not 0 <= delay_ms <= _LONGEST_DELAY_MS:
        texts["ev_delay"] = f"# EKF2_EV_DELAY would be {delay_ms:.1f} ms; PX4 takes 0 to 300 ms"
    lines = [
        f"{name}, by hand_eye_calib {version_of()}. {result.headline}.",
        f"Maps coordinates of {source} into {target}: the pose of {source} in {target}.",
        f"Clocks: t({result.parent_frame}) = t({result.child_frame}) "
        f"{'-' if result.time_offset_s < 0 else '+'} {_number(abs(result.time_offset_s))} s, "
        + ("estimated." if result.time_offset_sigma_s else "given, not estimated."),
    ]
    if is_inverted:
        lines.append(f"Inverted: the calibration is the pose of {target} in {source}.")
    if not is_certain:
        roles = zip((target, source), layout[:2], strict=True)
        said = ", ".join(f"{frame} is the {role}" for frame, role in roles if role)
        lines.append(f"Assumed, because the names of the frames do not say it: {said}.")
    if layout.axes_said:
        lines.append(layout.axes_said % {"target": target, "source": source})
    lines = [printable(" ".join(line.split())) for line in lines]
    texts["about"] = "\n".join(f"# {line}" for line in lines)
    if name == "kitti" or layout.text.startswith(("{", "[")):  # a value, not a comment
        texts["about"] = json.dumps(" ".join(lines) if name == "kitti" else lines)
    return layout.text % texts


def _numbers(T: FloatArray) -> dict[str, str]:
    """The texts of a pose (4, 4) that layouts need."""
    t = T[:3, 3]
    R = T[:3, :3]
    rpy = se3.rotation_to_rpy(T[:3, :3])
    qx, qy, qz, qw = quat_xyzw = se3.to_quat_xyzw(T)
    numbers = dict(zip(AXES, [*t, *rpy], strict=True)) | {"y_frd": -t[1], "z_frd": -t[2]}
    numbers |= {"qx": qx, "qy": qy, "qz": qz, "qw": qw}
    rows = [_listed(row) for row in T]
    return {axis: _number(value) for axis, value in numbers.items()} | {
        "t": _listed(t),
        "t_plain": _listed(t, " "),
        "R": _listed(R.ravel()),
        "R_plain": _listed(R.ravel(), " "),
        "rows": "\n".join(f"    - [{row}]" for row in rows),
        "plain_rows": "\n".join(_listed(row, " ") for row in T),
        "matrix": ",\n           ".join(rows),
        "xyzw": _listed(quat_xyzw),
        "wxyz": _listed(np.roll(quat_xyzw, 1)),
        "rpy_deg": _listed(np.degrees(rpy)),
    }


def _listed(values: FloatArray, separator: str = ", ") -> str:
    return separator.join(map(_number, values))


def _number(value: float) -> str:
    """A number that every parser takes for one with a fraction, never in powers of ten."""
    text = f"{round(float(value), _DECIMALS) + 0.0:.{_DECIMALS}f}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text
