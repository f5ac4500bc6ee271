"""Options of the engine and of the node: name, unit, range, default and help text.

Parameters of the node, options of the command line, ``config/calibrator.yaml`` and tables of the
documentation are generated from these dataclasses, or tested against them.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import InitVar, dataclass
from typing import Any, NamedTuple, Self

import hand_eye_calib.core.base.text as text
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import OptionSet, option
from hand_eye_calib.core.base.registry import LIVE_READINGS, MEASURES

TRAJECTORY_FORMATS = ("tum", "kitti", "euroc", "csv")
# The same names as in formats/layouts.yaml.
EXPORT_FORMATS = (
    *(
        "autoware",
        "fast_lio",
        "fast_livo2",
        "lio_sam",
        "kalibr",
        "openvins",
        "vins",
        "orbslam3",
    ),
    *(
        "apollo",
        "dlio",
        "glim",
        "msa",
        "px4",
        "kitti",
        "nuscenes",
        "colmap",
        "driveworks",
    ),
    *("easy_handeye2", "opencv", "numpy"),
)
#: File formats of robot descriptions and launch files. They are not formats of other programs.
ROBOT_FORMATS = ("urdf", "launch")
PAIR_BY = ("time", "row", "name")
STAMP_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
POSE_TYPES = (
    "auto",
    "nav_msgs/msg/Odometry",
    *(
        f"geometry_msgs/msg/{name}Stamped"
        for name in ("Pose", "PoseWithCovariance", "Transform")
    ),
    *(
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/NavSatFix",
        "geometry_msgs/msg/PointStamped",
    ),
)

BACKENDS = ("fast", "ipopt")

# Largest time offset (s): about the largest int64 number of nanoseconds. Clocks may start in 1970,
# in 1904, with the computer or with the GPS week.
_MAX_OFFSET_S = 9.2e9


class MethodRecord(NamedTuple):
    """Properties of a method.

    Attributes
    ----------
    uses_reference : bool
        Whether the method solves the motion pairs of a reference. Otherwise, it uses all poses.
    rejects_outliers : bool
        Whether the method rejects outliers, so that a few jumps hardly change the result.
    backends : tuple of str
        Allowed values of the option ``backend``.
    """

    uses_reference: bool = True
    rejects_outliers: bool = False
    backends: tuple[str, ...] = BACKENDS[:1]


METHODS = {
    "auto": MethodRecord(uses_reference=False, rejects_outliers=True),
    "dnlo": MethodRecord(rejects_outliers=True, backends=BACKENDS),
    "dnl": MethodRecord(backends=BACKENDS),
    **dict.fromkeys(("park", "taylor", "zhuang", "ali"), MethodRecord()),
    "adaptive": MethodRecord(uses_reference=False, rejects_outliers=True),
    "robust": MethodRecord(rejects_outliers=True),
}


def require_backend(method: str, backend: str) -> None:
    """Raise ConfigError if a method lacks a backend. The message lists the methods that have it."""
    if backend not in METHODS[method].backends:
        able = [
            name
            for name, record in METHODS.items()
            if backend in record.backends
        ]
        raise ConfigError(
            f"method {method} has no backend {backend}; set method {' or '.join(able)}"
        )


def _both(default: str, doc: str, **settings: Any) -> dict[str, Any]:
    """Return an option for each stream. Its name replaces {} in the help text ``doc``."""
    return {
        stream: option(default, doc.format(stream), **settings)
        for stream in ("parent", "child")
    }


_TF_SOURCE = _both(
    "",
    "Take the poses of the {0} sensor from /tf and /tf_static instead of "
    "{0}_odom: WORLD:SENSOR, the fixed frame and the sensor's frame, such as "
    "odom:lidar. Empty for the topic.",
    read_only=True,
    parse=text.split_frames,
)
_TYPE = _both(
    "auto",
    "Message type of {}_odom. auto: the type of the publisher.",
    choices=(*POSE_TYPES, *LIVE_READINGS),
    read_only=True,
)
_MEASURES = _both(
    "auto",
    "Quantity that the {} sensor measures: poses; positions (a GNSS antenna, "
    "a prism); rotations without positions; or angular rates. auto: by the "
    "message type or the columns.",
    choices=("auto", *MEASURES),
    read_only=True,
)
_INVERT = _both(
    "none",
    "Invert the {}'s poses, or only its orientations, if they are those "
    "of the world in the sensor's frame.",
    choices=("none", "poses", "orientations"),
)
_QUATERNION = _both(
    "xyzw",
    "True order of the {}'s four quaternion numbers that are read as x y z w. "
    "wxyz: the numbers are w x y z. yzwx: columns are named w x y z, but "
    "contain x y z w.",
    choices=("xyzw", "wxyz", "yzwx"),
)
_KIND = _both(
    "odometry",
    "Constant errors of the {} sensor's poses, which no recording reveals. "
    "odometry (lidar, camera, wheels): every standard deviation contains an "
    "allowance for them. exact (motion capture, surveyed, an INS with RTK, "
    "simulated without drift): no allowance.",
    choices=("odometry", "exact"),
)


_EXAMPLES = {"m": "1.85+/-0.02 or 185cm+/-2cm", "rad": "-90deg+/-2deg"}
_UNITS_NEEDED = {
    "m": "More than 5 m needs its unit, as in 8m+/-0.02m. ",
    "rad": "",
}
_PRIOR: dict[str, Any] = {
    axis: option(
        "",
        f"Prior on {axis} of the child sensor in the parent sensor's frame: VALUE+/-SIGMA, "
        f"such as {_EXAMPLES[unit]}. {_UNITS_NEEDED[unit]}Empty for none.",
        unit=unit,
        parse=text.parse_prior,
    )
    for axis, unit in text.AXIS_UNITS.items()
}


@dataclass(frozen=True, kw_only=True)
class CalibratorConfig(OptionSet):
    """Options of the engine, for the node, the replay of bags, files and Python.

    Attributes
    ----------
    given : frozenset of str
        Names of the options that the user has set, even to their defaults. ``dataclasses.replace``
        keeps these names.

    Examples
    --------
    >>> config = hec.CalibratorConfig(method="dnlo", prior_z="1.85+-0.02")
    >>> config.prior()
    {'z': (1.85, 0.02)}
    """

    given: InitVar[Collection[str] | None] = None

    def __new__(cls, **values: Any) -> Self:
        """Store the names of the passed options."""
        config = super().__new__(cls)
        names = values if values.get("given") is None else values["given"]
        object.__setattr__(config, "given", frozenset(names) - {"given"})
        return config

    method: str = option(
        "auto",
        "Method of the solve. auto: adaptive if its noise model fits, "
        "otherwise dnlo; also dnlo if a reference is set. dnlo rejects "
        "outliers, robust reduces their weights. adaptive estimates the "
        "noise and needs no reference. The others use all motion pairs.",
        choices=tuple(METHODS),
    )
    reference: str = option(
        "auto",
        "Poses that form motion pairs: A (each with the first), B<n> (each "
        "with the n-th before it), C<n> (each with the first of its segment "
        "of n), or auto (the reference with the estimate nearest to that of "
        "adaptive).",
        parse=lambda name, value: (
            value == "auto" or text.parse_reference(name, value)
        ),
    )
    backend: str = option(
        "fast",
        "fast: the quadratic-form solver; ipopt: the paper's CasADi + Ipopt formulation, for dnlo "
        "and dnl.",
        choices=BACKENDS,
    )
    threshold: float = option(
        0.01,
        "DNLO: pairs with a larger cost are outliers (c of eq. 5).",
        unit="m^2",
        within=(1e-12, 1e6),
    )
    min_inlier_fraction: float = option(
        0.5,
        "DNLO: at least this share of the pairs counts as inliers (d of eq. 5, as a share).",
        within=(0.0, 1.0),
    )
    min_pairs: int = option(
        10,
        "Smallest number of synchronised pose pairs to solve with.",
        within=(3, 1_000_000),
    )
    max_pairs: int = option(
        5000,
        "Largest number of synchronised pose pairs to keep; more are downsampled.",
        within=(10, 100_000_000),
    )
    keyframe_min_translation: float = option(
        0.0,
        "Keep a pose pair if the parent sensor has moved this far since the "
        "last kept pair, or rotated by keyframe.min_rotation. 0: off.",
        unit="m",
        within=(0.0, 100.0),
    )
    keyframe_min_rotation: float = option(
        0.0,
        "Keep a pose pair if the parent sensor has rotated by this angle "
        "since the last kept pair, or moved keyframe.min_translation. 0: off.",
        unit="rad",
        within=(0.0, math.pi),
    )
    keyframe_min_interval: float = option(
        0.0,
        "Smallest time between kept pose pairs.",
        unit="s",
        within=(0.0, 60.0),
    )
    max_gap: float = option(
        0.5,
        "Longest time between two poses of a stream across which the stream is interpolated.",
        unit="s",
        within=(1e-3, 60.0),
    )
    time_offset: float | str = option(
        0.0,
        "Added to the child's stamps to get the parent's clock. estimate: "
        "from the angular rates of both streams, for offsets of any size.",
        unit="s",
        words=("estimate",),
        within=(-_MAX_OFFSET_S, _MAX_OFFSET_S),
    )
    scale: float | str = option(
        "none",
        "Factor from the child's lengths to metres. estimate: from the "
        "motion. auto: estimated, and used only if it clearly differs from 1.",
        words=("none", "auto", "estimate"),
        within=(1e-6, 1e6),
    )
    parent_scale: float = option(
        1.0,
        "Factor from the parent's lengths to metres, such as 0.001 for millimetres.",
        within=(1e-6, 1e6),
    )
    parent_measures: str = _MEASURES["parent"]
    child_measures: str = _MEASURES["child"]
    parent_invert: str = _INVERT["parent"]
    child_invert: str = _INVERT["child"]
    parent_quaternion: str = _QUATERNION["parent"]
    child_quaternion: str = _QUATERNION["child"]
    parent_kind: str = _KIND["parent"]
    child_kind: str = _KIND["child"]
    nominal_radius: float = option(
        0.0,
        "Radius of the wheels by their drawing, for wheel data: an estimate that differs is "
        "reported. 0: unknown.",
        unit="m",
        within=(0.0, 10.0),
    )
    nominal_separation: float = option(
        0.0,
        "Distance between the left and the right wheels by the drawing, for wheel data and the "
        "parameters of a controller. 0: unknown.",
        unit="m",
        within=(0.0, 100.0),
    )
    prior_x: str = _PRIOR["x"]
    prior_y: str = _PRIOR["y"]
    prior_z: str = _PRIOR["z"]
    prior_roll: str = _PRIOR["roll"]
    prior_pitch: str = _PRIOR["pitch"]
    prior_yaw: str = _PRIOR["yaw"]
    target_translation: float = option(
        0.02,
        "Standard deviation along each axis that is good enough, for the "
        "verdict and the stop rule.",
        unit="m",
        within=(1e-6, 1.0),
    )
    target_rotation: float = option(
        0.00524,
        "Standard deviation about each axis that is good enough, by default "
        "0.3 deg, for the verdict and the stop rule.",
        unit="rad",
        within=(1e-6, 0.2),
    )
    target_axes: str = option(
        "",
        "Targets of single axes in place of target.translation and target.rotation, such as z=10cm "
        "yaw=0.5deg. Empty for none.",
        parse=text.parse_targets,
    )
    parent_frame: str = option(
        "",
        "Name of the parent sensor's frame. Empty for the name in the messages.",
        read_only=True,
    )
    child_frame: str = option(
        "",
        "Name of the child sensor's frame. Empty for the name in the messages.",
        read_only=True,
    )

    def is_known(self, name: str) -> bool:
        """Return whether the user set ``time_offset`` or ``scale`` to a value, not an estimate."""
        return name in self.given and getattr(self, name) not in (
            "auto",
            "estimate",
        )

    @property
    def given_time_offset_s(self) -> float:
        """Value (s) of the option ``time_offset`` if it is a number; 0 if it is "estimate"."""
        return 0.0 if isinstance(self.time_offset, str) else self.time_offset

    @property
    def given_scale(self) -> float:
        """Value of the option ``scale`` if it is a number; 1 if it is a word."""
        return 1.0 if isinstance(self.scale, str) else self.scale

    @property
    def measured(self) -> str:
        """Kind of data of both streams together, such as "poses", "rotations" or "positions".

        Raises
        ------
        ConfigError
            If the streams cannot be calibrated together, such as two streams of positions.
        """
        words = (self.parent_measures, self.child_measures)
        # Streams that do not measure whole poses.
        partial = [
            MEASURES[word] for word in words if word not in ("auto", "poses")
        ]
        if not partial:
            return "poses"
        kinds = {measure.kind for measure in partial}
        # Reasons why a quantity needs poses beside it. Two streams without poses are then refused.
        reasons = [
            measure.needs_poses for measure in partial if measure.needs_poses
        ]
        if len(kinds) == 1 and not (reasons and len(partial) == 2):
            self._require_order()
            return kinds.pop()
        reason = (
            reasons[0]
            if reasons
            else "these kinds of streams cannot be calibrated together"
        )
        raise ConfigError(
            f"{reason}; the parent measures {self.parent_measures}, the child {self.child_measures}"
        )

    def _require_order(self) -> None:
        """Raise ConfigError if the child measures a quantity that only the parent may measure."""
        measured = self.child_measures
        if measured != "auto" and MEASURES[measured].is_parent:
            raise ConfigError(
                f"{measured} can only be the parent: exchange the streams, "
                f"the one with {measured} first"
            )

    def require_poses(self, request: str) -> None:
        """Raise ConfigError if a sensor does not measure poses.

        The message begins with ``request``, the feature that needs poses.
        """
        if self.measured != "poses":
            raise ConfigError(
                f"{request} needs poses of both sensors; the parent measures "
                f"{self.parent_measures}, the child {self.child_measures}"
            )

    @property
    def targets(self) -> tuple[float, ...]:
        """Target standard deviations (6,) of x, y, z (m), roll, pitch and yaw (rad)."""
        single = text.parse_targets("target.axes", self.target_axes)
        of_unit = {"m": self.target_translation, "rad": self.target_rotation}
        return tuple(
            single.get(axis, of_unit[unit])
            for axis, unit in text.AXIS_UNITS.items()
        )

    def prior(self) -> dict[str, tuple[float, float]]:
        """Return the prior: (value, standard deviation) in m or rad, by the name of the axis."""
        priors = {}
        for axis in text.AXIS_UNITS:
            value = getattr(self, f"prior_{axis}")
            if value:
                priors[axis] = text.parse_prior(f"prior.{axis}", value)
        return priors


# Largest number of further child sensors of the node.
MOST_OTHERS = 7


def other_names(count: int = MOST_OTHERS) -> list[str]:
    """Return the names of the inputs of ``count`` further child sensors: child2, child3, ..."""
    return [f"child{number}" for number in range(2, count + 2)]


def defaults_of(names: Iterable[str]) -> dict[str, Any]:
    """Return the default values of options of the engine, by name."""
    return {name: getattr(CalibratorConfig, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class NodeConfig(OptionSet):
    """Options that only the node has, in addition to the options of the engine."""

    solve_period: float = option(
        2.0, "Time between solves.", unit="s", within=(0.05, 3600.0)
    )
    parent_type: str = _TYPE["parent"]
    child_type: str = _TYPE["child"]
    other_children: int = option(
        0,
        "Number of further child sensors, with poses on child2_odom, "
        "child3_odom and so on. Whenever the result is saved, a separate "
        "process solves all sensors together, into rig/ of output_directory.",
        within=(0, MOST_OTHERS),
        read_only=True,
    )
    parent_tf: str = _TF_SOURCE["parent"]
    child_tf: str = _TF_SOURCE["child"]
    output_directory: str = option(
        "",
        "Directory of the journal and of all saved results. Empty for none.",
    )
    journal: str = option(
        "new",
        "Journal of the session, in journal/ of output_directory: a crash "
        "then loses less than a second. new: start a session and keep the "
        "previous journal. resume: continue the session on disk. off: no "
        "journal.",
        choices=("new", "resume", "off"),
        read_only=True,
    )
    enabled: bool = option(
        True,
        "Accept poses from the start; false waits for ~/set_enabled.",
        read_only=True,
    )
    report: bool = option(
        True,
        "Also write report.html whenever the result is saved, in a separate "
        "process that ends some seconds after the node.",
    )
    publish_tf: bool = option(
        False,
        "Broadcast the result on /tf_static once the targets are reached. "
        "Keep it off if the robot description has this transform.",
    )
    installed: str = option(
        "",
        "Installed transform, to compare the result with: tf (from "
        "/tf_static), a URDF, an earlier extrinsic.yaml, a file of another "
        "program, a bag, or X Y Z ROLL PITCH YAW in m and rad. Empty for "
        "none.",
        read_only=True,
    )
    base_frame: str = option(
        "",
        "Also state the child sensor's pose in this frame, from /tf_static. "
        "Saved files and publish_tf then use this frame. Empty for none.",
        read_only=True,
    )
    lifecycle: bool = option(
        False,
        "Be a managed node: another program, such as nav2_lifecycle_manager, "
        "configures, activates, deactivates and cleans up the node. enabled "
        "and ~/set_enabled have no meaning then.",
        read_only=True,
    )
    monitor: bool = option(
        False,
        "Monitor the mount instead of calibrating: compare the motion with "
        "installed, and raise an alarm after a shift. false ends the monitor "
        "and calibrates anew.",
    )
