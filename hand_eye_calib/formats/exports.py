"""Extrinsics in the files of other programs. Their layouts are in ``layouts.yaml``.

The direction of a transform is the most frequent mistake. Therefore each file names source and
target frame of its numbers, and states whether the calibration was inverted. docs/exports.md names
the sources for the directions.
"""

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import ROBOT_FORMATS
from hand_eye_calib.core.base.errors import ConfigError, InputError, printable
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import Judged, Verdict
from hand_eye_calib.formats.results import launch_text, xacro_text

# Beginnings of words in a frame's name, by the kind of sensor. The kinds are sorted by their usual
# distance from the body.
_ROLES = {
    "base": ("base", "ego", "vehicle", "chassis", "rig", "hand", "tool", "flange"),
    "imu": ("imu", "body", "gyro", "ins", "novatel", "xsens"),
    "lidar": ("lidar", "velo", "ouster", "livox", "laser", "hesai", "pandar", "rslidar", "scan"),
    "camera": ("cam", "image", "optical", "rgb", "stereo", "realsense", "zed", "vio", "vision"),
    "gnss": ("gnss", "gps", "antenna", "rtk"),
}
_RANKS = {role: rank for rank, role in enumerate(_ROLES)}
# Decimals of the numbers in a file. For metres, the last digit is 1 pm.
_DECIMALS = 12
# Longest delay (ms) that PX4 accepts (EKF2_EV_DELAY).
_LONGEST_DELAY_MS = 300.0


class Layout(NamedTuple):
    """Layout of a format for two kinds of sensors. Its numbers are ``T_target_source``.

    Attributes
    ----------
    target, source : str
        Kinds of the sensors; empty for any kind.
    is_inverted : bool or None
        True if the target is the child, False if it is the parent, None if either is possible.
    keys : sequence of str
        Keys of the pose in the file, or of translation and rotation.
    text : str
        Text of the file, with ``%(name)s`` for numbers and names.
    clock : int
        Sign of the shift in ``t_target = t_source + clock * shift``; 0 if the file has no shift.
    axes : sequence of str
        Axes that the recording must determine.
    axes_note : str
        Note about the axes, for the user of the file.
    """

    target: str = ""
    source: str = ""
    is_inverted: bool | None = None
    keys: Sequence[str] = ()
    text: str = ""
    clock: int = 0
    axes: Sequence[str] = AXES
    axes_note: str = ""


class Arrangement(NamedTuple):
    """Layout for two sensors, and its direction.

    Attributes
    ----------
    layout : Layout
    is_inverted : bool
        Whether its numbers are ``T_child_parent``.
    is_certain : bool
        Whether the names of the frames state the kinds of the sensors.
    """

    layout: Layout
    is_inverted: bool
    is_certain: bool


@cache
def formats() -> dict[str, list[Layout]]:
    """Return the layouts of each format."""
    text = Path(__file__).with_name("layouts.yaml").read_text(encoding="utf-8")
    document = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {name: [Layout(**fields) for fields in layouts] for name, layouts in document.items()}


def role_of(frame: str) -> str:
    """Return the kind of a sensor, from the name of its frame; empty if the name states none."""
    words = re.findall("[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", frame).lower())
    roles = [
        role
        for role, beginnings in _ROLES.items()
        if any(word.startswith(beginnings) for word in words)
    ]
    # A second role is preferred to "base": base_imu_link belongs to an IMU.
    if len(roles) > 1 and roles[0] == "base":
        return roles[1]
    return roles[0] if roles else ""


def arranged(layouts: Sequence[Layout], parent_frame: str, child_frame: str) -> Arrangement:
    """Return the layout and the direction that fit the sensors best.

    The criteria are, in this order: most matching kinds of sensors, fewest differing kinds, the
    first layout, and a parent that is nearer to the body than the child.
    """
    roles = (role_of(parent_frame), role_of(child_frame))
    best_score: tuple[Any, ...] = ()
    for order, layout in enumerate(layouts):
        directions = (False, True) if layout.is_inverted is None else (layout.is_inverted,)
        for is_inverted in directions:
            wanted = (layout.target, layout.source)
            if is_inverted:
                wanted = (layout.source, layout.target)
            pairs = list(zip(wanted, roles, strict=True))
            n_matches = sum(kind == role != "" for kind, role in pairs)
            n_misses = sum(kind not in ("", role) for kind, role in pairs)
            is_natural = _RANKS.get(wanted[0], 0) <= _RANKS.get(wanted[1], 0)
            score = (n_matches, -n_misses, -order, is_natural)
            if score > best_score:
                best_score = score
                best = Arrangement(layout, is_inverted, is_certain=n_misses == 0)
    return best


def export_text(result: Judged, name: str) -> str:
    """Return a calibration in the format of another program.

    See :meth:`~hand_eye_calib.core.results.calibration.Calibration.export`.

    Raises
    ------
    ConfigError
        For an unknown format.
    InputError
        If the result is not usable, or an axis that the format needs is not determined.
    """
    if name not in (*formats(), *ROBOT_FORMATS):
        known = ", ".join([*formats(), *ROBOT_FORMATS])
        raise ConfigError(f"unknown format {name!r}; known are {known}")
    if result.verdict is Verdict.DO_NOT_USE:
        raise InputError(f"nothing is written: {result.headline}")
    if name == "urdf":
        return xacro_text(result)
    if name == "launch":
        return launch_text([result])
    return _filled_layout(result, name)


def _filled_layout(result: Judged, name: str) -> str:
    """Return a calibration in a format of layouts.yaml, see :func:`export_text`."""
    frames = (result.parent_frame, result.child_frame)
    T = result.T_parent_child
    arrangement = arranged(formats()[name], *frames)
    layout = arrangement.layout
    # The target of such a format is a vehicle or robot: prefer the frame of its description.
    if layout.is_inverted is False and not layout.target:
        frames = (result.mounting[0], result.child_frame)
        T = result.mounting[1]
    if unknown := [axis for axis in result.unobservable() if axis in layout.axes]:
        raise InputError(
            "no file is written: this recording does not determine "
            f"{axes_in_words(unknown)}; measure it by hand and calibrate "
            "again with --prior"
        )
    target, source = frames
    offset_s = result.time_offset_s
    if arrangement.is_inverted:
        target, source = source, target
        T = se3.inverse(T)
        offset_s = -offset_s
    texts = _numbers(T) | _robot_frames(target)
    # The delay of PX4 is that of the child, whatever the direction of the transform.
    texts |= {
        "target": json.dumps(target),
        "source": json.dumps(source),
        "shift": _number(layout.clock * offset_s),
        "ev_delay": _delay_of_px4(-1e3 * result.time_offset_s),
    }
    lines = _remarks(result, name, arrangement, target, source)
    lines = [printable(" ".join(line.split())) for line in lines]
    # Files of kitti and JSON have no comments, so the remarks are a value.
    if name == "kitti":
        texts["about"] = json.dumps(" ".join(lines))
    elif layout.text.startswith(("{", "[")):
        texts["about"] = json.dumps(lines)
    else:
        texts["about"] = "\n".join(f"# {line}" for line in lines)
    return layout.text % texts


def _robot_frames(target: str) -> dict[str, str]:
    """Return the texts of a robot's base and hand. The target is one of these frames."""
    # The camera is beside the robot, not on its hand.
    if "base" in target.lower():
        return {"eye": "eye_on_base", "robot": json.dumps(target), "effector": '"hand"'}
    return {"eye": "eye_in_hand", "robot": '"base"', "effector": json.dumps(target)}


def _delay_of_px4(delay_ms: float) -> str:
    """Return the command that sets a delay in PX4; a comment if PX4 does not accept the delay."""
    if 0 <= delay_ms <= _LONGEST_DELAY_MS:
        return f"param set EKF2_EV_DELAY {_number(round(delay_ms, 3))}"
    return f"# EKF2_EV_DELAY would be {delay_ms:.1f} ms; PX4 accepts 0 to 300 ms"


def _remarks(
    result: Judged, name: str, arrangement: Arrangement, target: str, source: str
) -> list[str]:
    """Return remarks for the user in a file: direction, clocks, assumptions and axes."""
    layout = arrangement.layout
    sign = "-" if result.time_offset_s < 0 else "+"
    origin = "estimated" if result.time_offset_sigma_s else "given, not estimated"
    lines = [
        f"{name}, by hand_eye_calib {version_of()}. {result.headline}.",
        f"Maps coordinates of {source} into {target}: the pose of {source} in {target}.",
        f"Clocks: t({result.parent_frame}) = t({result.child_frame}) "
        f"{sign} {_number(abs(result.time_offset_s))} s, {origin}.",
    ]
    if arrangement.is_inverted:
        lines.append(f"Inverted: the calibration is the pose of {target} in {source}.")
    if not arrangement.is_certain:
        kinds = ((target, layout.target), (source, layout.source))
        assumed = ", ".join(f"{frame} is the {kind}" for frame, kind in kinds if kind)
        lines.append(f"Assumed, because the names of the frames do not contain it: {assumed}.")
    if layout.axes_note:
        lines.append(layout.axes_note % {"target": target, "source": source})
    return lines


def _numbers(T: FloatArray) -> dict[str, str]:
    """Return the texts of a pose (4, 4) for layouts."""
    t = se3.translation_of(T)
    R = se3.rotation_of(T)
    rpy_rad = se3.rotation_to_rpy(R)
    quat_xyzw = se3.to_quat_xyzw(T)
    numbers = dict(zip(AXES, [*t, *rpy_rad], strict=True))
    numbers |= zip(("qx", "qy", "qz", "qw"), quat_xyzw, strict=True)
    numbers |= {"y_frd": -t[1], "z_frd": -t[2]}
    rows = [_listed(row) for row in T]
    return {name: _number(value) for name, value in numbers.items()} | {
        "t": _listed(t),
        "t_plain": _listed(t, " "),
        "R": _listed(R.ravel()),
        "R_plain": _listed(R.ravel(), " "),
        "rows": "\n".join(f"    - [{row}]" for row in rows),
        "plain_rows": "\n".join(_listed(row, " ") for row in T),
        "matrix": ",\n           ".join(rows),
        "xyzw": _listed(quat_xyzw),
        "wxyz": _listed(np.roll(quat_xyzw, 1)),
        "rpy_deg": _listed(np.degrees(rpy_rad)),
    }


def _listed(values: FloatArray, separator: str = ", ") -> str:
    return separator.join(map(_number, values))


def _number(value: float) -> str:
    """Format a number with a decimal point and without an exponent, for every parser."""
    # Adding 0.0 turns -0.0 into 0.0.
    text = f"{round(float(value), _DECIMALS) + 0.0:.{_DECIMALS}f}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text
