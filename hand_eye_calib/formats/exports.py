"""Write extrinsics into the files of other programs, whose layouts are in ``layouts.yaml``.

A wrong direction of the transform is the most frequent mistake. Therefore each file names the
source frame and the target frame of its numbers, and states whether the calibration was inverted.
docs/exports.md lists the sources for the directions.
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
from hand_eye_calib.core.results.reasons import Verdict
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import Judged
from hand_eye_calib.formats.results import launch_text, xacro_text

# Beginnings of words in frame names, for each kind of sensor. The kinds are in their usual order on
# a vehicle: first the base, then the sensors to which other sensors are calibrated.
_ROLES = {
    "base": (
        "base",
        "ego",
        "vehicle",
        "chassis",
        "rig",
        "hand",
        "tool",
        "flange",
    ),
    "imu": ("imu", "body", "gyro", "ins", "novatel", "xsens"),
    "lidar": (
        "lidar",
        "velo",
        "ouster",
        "livox",
        "laser",
        "hesai",
        "pandar",
        "rslidar",
        "scan",
    ),
    "camera": (
        "cam",
        "image",
        "optical",
        "rgb",
        "stereo",
        "realsense",
        "zed",
        "vio",
        "vision",
    ),
    "gnss": ("gnss", "gps", "antenna", "rtk"),
}
# Position of each kind in this order.
_RANKS = {role: rank for rank, role in enumerate(_ROLES)}
# Number of decimals in a file. The last digit of a length in metres is 1 pm.
_DECIMALS = 12
# Largest delay (ms) that PX4 accepts for its parameter EKF2_EV_DELAY.
_MAX_DELAY_MS = 300.0


class Layout(NamedTuple):
    """Layout of a file format for two kinds of sensors.

    The file contains the transform ``T_target_source``, the pose of the source in the target.

    Attributes
    ----------
    target, source : str
        Kind of each sensor, such as "lidar"; empty for any kind.
    is_inverted : bool or None
        True if the target is the child, False if the target is the parent, None if both are
        possible.
    keys : sequence of str
        Keys of the pose in the file, or of its translation and its rotation.
    text : str
        Text of the file, with ``%(name)s`` for numbers and names.
    clock : int
        Sign in ``t_target = t_source + clock * shift``, the shift of clocks; 0 if the file has no
        shift.
    axes : sequence of str
        Axes that the file needs. The recording must determine them.
    axes_note : str
        Note about these axes, which is written into the file.
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
    """Layout for a pair of sensors, and the direction of its transform.

    Attributes
    ----------
    layout : Layout
    is_inverted : bool
        True if the file contains ``T_child_parent`` instead of ``T_parent_child``.
    is_certain : bool
        Whether the frame names indicate the kinds of sensors in the layout.
    """

    layout: Layout
    is_inverted: bool
    is_certain: bool


@cache
def formats() -> dict[str, list[Layout]]:
    """Return the layouts of each format."""
    text = Path(__file__).with_name("layouts.yaml").read_text(encoding="utf-8")
    document = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {
        name: [Layout(**fields) for fields in layouts]
        for name, layouts in document.items()
    }


def role_of(frame: str) -> str:
    """Return the kind of a sensor according to its frame name; empty for unknown names."""
    words = re.findall(
        "[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", frame).lower()
    )
    roles = [
        role
        for role, beginnings in _ROLES.items()
        if any(word.startswith(beginnings) for word in words)
    ]
    # Another kind has priority over "base": base_imu_link is the frame of an IMU.
    if len(roles) > 1 and roles[0] == "base":
        return roles[1]
    return roles[0] if roles else ""


def arranged(
    layouts: Sequence[Layout], parent_frame: str, child_frame: str
) -> Arrangement:
    """Return the layout and the direction that fit the sensors best.

    The criteria are, in order: the number of sensors whose kind matches the layout, the number
    whose kind contradicts it, the order of the layouts, and a parent before the child in
    ``_RANKS``.
    """
    roles = (role_of(parent_frame), role_of(child_frame))
    best_score: tuple[Any, ...] = ()
    for index, layout in enumerate(layouts):
        directions = (
            (False, True)
            if layout.is_inverted is None
            else (layout.is_inverted,)
        )
        for is_inverted in directions:
            # Kinds of parent and child in this direction; empty for any kind.
            kinds = (layout.target, layout.source)
            if is_inverted:
                kinds = (layout.source, layout.target)
            pairs = list(zip(kinds, roles, strict=True))
            n_matches = sum(kind == role != "" for kind, role in pairs)
            n_contradictions = sum(
                kind not in ("", role) for kind, role in pairs
            )
            is_usual_order = _RANKS.get(kinds[0], 0) <= _RANKS.get(kinds[1], 0)
            score = (n_matches, -n_contradictions, -index, is_usual_order)
            if score > best_score:
                best_score = score
                best = Arrangement(
                    layout, is_inverted, is_certain=n_contradictions == 0
                )
    return best


def export_text(result: Judged, name: str) -> str:
    """Return the text of a calibration file for another program.

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
    """Return a calibration in a format of ``layouts.yaml``, see :func:`export_text`."""
    frames = (result.parent_frame, result.child_frame)
    T = result.T_parent_child
    arrangement = arranged(formats()[name], *frames)
    layout = arrangement.layout
    # The parent of this layout is the vehicle. Its frame is in the robot's description; the pose in
    # this frame (``mounting``) replaces the pose in the frame of the parent sensor.
    if layout.is_inverted is False and not layout.target:
        frames = (result.mounting[0], result.child_frame)
        T = result.mounting[1]
    if unknown := [
        axis for axis in result.unobservable() if axis in layout.axes
    ]:
        raise InputError(
            "no file is written: this recording does not determine "
            f"{axes_in_words(unknown)}; measure the missing values by hand, and calibrate again "
            "with priors"
        )
    target, source = frames
    offset_s = result.time_offset_s
    if arrangement.is_inverted:
        target, source = source, target
        T = se3.inverse(T)
        offset_s = -offset_s
    texts = _numbers(T) | _robot_frames(target)
    # PX4 expects the delay of the child, in both directions of the transform.
    texts |= {
        "target": json.dumps(target),
        "source": json.dumps(source),
        "shift": _number(layout.clock * offset_s),
        "ev_delay": _delay_of_px4(-1e3 * result.time_offset_s),
    }
    lines = _remarks(result, name, arrangement, target, source)
    lines = [printable(" ".join(line.split())) for line in lines]
    # Files of KITTI and JSON cannot contain comments, so the remarks are a value.
    if name == "kitti":
        texts["about"] = json.dumps(" ".join(lines))
    elif layout.text.startswith(("{", "[")):
        texts["about"] = json.dumps(lines)
    else:
        texts["about"] = "\n".join(f"# {line}" for line in lines)
    return layout.text % texts


def _robot_frames(target: str) -> dict[str, str]:
    """Return the values of a layout for a robot arm: base, hand, and place of the camera.

    The target is the base or the hand.
    """
    if "base" in target.lower():
        # The camera is fixed beside the robot.
        return {
            "eye": "eye_on_base",
            "robot": json.dumps(target),
            "effector": '"hand"',
        }
    return {
        "eye": "eye_in_hand",
        "robot": '"base"',
        "effector": json.dumps(target),
    }


def _delay_of_px4(delay_ms: float) -> str:
    """Return the command that sets a delay in PX4; a comment if the delay is out of range."""
    if 0 <= delay_ms <= _MAX_DELAY_MS:
        return f"param set EKF2_EV_DELAY {_number(round(delay_ms, 3))}"
    return (
        f"# EKF2_EV_DELAY would be {delay_ms:.1f} ms; PX4 accepts 0 to 300 ms"
    )


def _remarks(
    result: Judged,
    name: str,
    arrangement: Arrangement,
    target: str,
    source: str,
) -> list[str]:
    """Return remarks for the user of a file, about direction, clocks, assumptions and axes."""
    layout = arrangement.layout
    sign = "-" if result.time_offset_s < 0 else "+"
    origin = (
        "estimated" if result.time_offset_sigma_s else "given, not estimated"
    )
    lines = [
        f"{name}, by hand_eye_calib {version_of()}. {result.headline}.",
        f"Maps coordinates of {source} into {target}: the pose of {source} in {target}.",
        f"Clocks: t({result.parent_frame}) = t({result.child_frame}) "
        f"{sign} {_number(abs(result.time_offset_s))} s, {origin}.",
    ]
    if arrangement.is_inverted:
        lines.append(
            f"Inverted: the calibration is the pose of {target} in {source}."
        )
    if not arrangement.is_certain:
        kinds = ((target, layout.target), (source, layout.source))
        assumed = ", ".join(
            f"{frame} is the {kind}" for frame, kind in kinds if kind
        )
        lines.append(
            f"Assumed, because the names of the frames do not contain it: {assumed}."
        )
    if layout.axes_note:
        lines.append(layout.axes_note % {"target": target, "source": source})
    return lines


def _numbers(T: FloatArray) -> dict[str, str]:
    """Return the values of a layout for a pose (4, 4): m, rad, quaternions and matrices."""
    t = se3.translation_of(T)
    R = se3.rotation_of(T)
    rpy_rad = se3.rotation_to_rpy(R)
    quat_xyzw = se3.to_quat_xyzw(T)
    numbers = dict(zip(AXES, [*t, *rpy_rad], strict=True))
    numbers |= zip(("qx", "qy", "qz", "qw"), quat_xyzw, strict=True)
    # Axes forward, right and down, as in PX4.
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
    """Return numbers as text."""
    return separator.join(map(_number, values))


def _number(value: float) -> str:
    """Return a number as text that every parser reads: a decimal point and no exponent."""
    # Rounding may produce -0.0. Adding 0.0 changes it to 0.0.
    rounded = round(float(value), _DECIMALS) + 0.0
    text = f"{rounded:.{_DECIMALS}f}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text
