"""Every option of the package, once: name, unit, range, default and meaning.

The node's parameters, the command line's options, ``config/calibrator.yaml`` and the README's
tables are made from these dataclasses or tested against them.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from hand_eye_calib.errors import ConfigError
from hand_eye_calib.methods import BACKENDS, METHODS

REFERENCE_PATTERN = r"auto|A|B[1-9][0-9]*|C([2-9]|[1-9][0-9]+)"
TRAJECTORY_FORMATS = ("tum", "kitti", "euroc", "csv")
STAMP_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
POSE_TYPES = (
    "auto",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)


def option(
    default,
    doc,
    *,
    unit="",
    minimum=None,
    maximum=None,
    choices=None,
    pattern=None,
    words=(),
    name=None,
    read_only=False,
    parse=None,
):
    """A dataclass field that knows all there is to know about an option.

    Parameters
    ----------
    default
        Its type is the option's type.
    doc : str
        One line for a person who is about to set it.
    unit : str
        Unit of the value, empty for none.
    minimum, maximum : float, optional
        Bounds, both allowed values.
    choices : tuple of str, optional
        The allowed values.
    pattern : str, optional
        Regular expression that the whole value must match.
    words : tuple of str
        Words that a number may be replaced by, such as "none".
    name : str, optional
        Public name where it differs from the attribute's, such as ``keyframe.min_translation``.
    read_only : bool
        The node cannot change it while it runs.
    parse : callable, optional
        Of a text option: ``parse(name, value)`` raises ConfigError where the value does not say
        what it has to.
    """
    metadata = dict(
        doc=doc, unit=unit, minimum=minimum, maximum=maximum, choices=choices, pattern=pattern, words=words, name=name,
        read_only=read_only, parse=parse,
    )  # fmt: skip
    return dataclasses.field(default=default, metadata=metadata)


def option_name(field):
    """Public name of an option: the ROS parameter, the YAML key."""
    return field.metadata["name"] or field.name


def check_value(field, value):
    """The value in the option's own type.

    Raises
    ------
    ConfigError
        Where the value is of the wrong type, out of range or not among the choices; one line that
        says what is allowed.
    """
    meta, name, kind = field.metadata, option_name(field), type(field.default)
    if isinstance(value, str) and value in meta["words"]:
        return value
    if meta["words"]:
        value, kind = _number(name, value, meta), float
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        value = float(value)
        if not math.isfinite(value):
            raise ConfigError(f"{name} must be a finite number; got {value}")
    elif kind is not type(value):
        raise ConfigError(f"{name} must be of type {kind.__name__}; got {value!r}")
    unit = f" {meta['unit']}" if meta["unit"] else ""
    if meta["minimum"] is not None and value < meta["minimum"]:
        raise ConfigError(f"{name} must be at least {meta['minimum']}{unit}; got {value}")
    if meta["maximum"] is not None and value > meta["maximum"]:
        raise ConfigError(f"{name} must be at most {meta['maximum']}{unit}; got {value}")
    if meta["choices"] is not None and value not in meta["choices"]:
        raise ConfigError(f"{name} must be one of {', '.join(meta['choices'])}; got {value!r}")
    if meta["pattern"] is not None and not re.fullmatch(meta["pattern"], value):
        raise ConfigError(f"{name} must match {meta['pattern']}; got {value!r}")
    if meta["parse"] is not None:
        meta["parse"](name, value)
    return value


def _number(name, value, meta):
    if isinstance(value, bool):
        raise ConfigError(f"{name} must be {' or '.join(meta['words'])} or a number; got {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ConfigError(
            f"{name} must be {' or '.join(meta['words'])} or a number; got {value!r}"
        ) from None


class OptionSet:
    """Base of dataclasses made of options: checks every value, and knows the options by their
    public names.
    """

    def __post_init__(self):
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, check_value(field, getattr(self, field.name)))

    @classmethod
    def from_options(cls, options):
        """Build from a mapping of public names; unknown names are an error that lists the known
        ones.
        """
        known = {option_name(field): field.name for field in dataclasses.fields(cls)}
        unknown = [name for name in options if name not in known]
        if unknown:
            raise ConfigError(
                f"unknown option {unknown[0]!r}; known are {', '.join(sorted(known))}"
            )
        return cls(**{known[name]: value for name, value in options.items()})

    def to_options(self):
        """Mapping of public names to values."""
        return {option_name(field): getattr(self, field.name) for field in dataclasses.fields(self)}


AXIS_UNITS = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_IN_SI = {"m": {"m": 1.0, "cm": 0.01, "mm": 0.001}, "rad": {"rad": 1.0, "deg": math.pi / 180}}
_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(m|cm|mm|rad|deg)?")


# What is known of the pose of the child sensor in the parent sensor's frame: for each of x, y, z (m),
# roll, pitch, yaw (rad) its value and standard deviation, or both as the text of the option
# ``prior.<axis>``. "transform" takes the text of ``prior.transform``.
Prior: TypeAlias = Mapping[str, tuple[float, float] | str]


def prior_fields(prior: Prior) -> dict[str, str]:
    """The prior options of a CalibratorConfig, by attribute, that say the same.

    Raises
    ------
    ConfigError
        If an axis is unknown or its value is not a text or a pair of numbers.
    """
    fields = {}
    for axis, known in prior.items():
        if axis not in (*AXIS_UNITS, "transform"):
            raise ConfigError(f"prior takes {', '.join(AXIS_UNITS)} or transform; got {axis!r}")
        if not isinstance(known, str):
            try:
                value, sigma = map(float, known)
            except (TypeError, ValueError):
                raise ConfigError(
                    f"prior {axis} must be (value, standard deviation) or a text; got {known!r}"
                ) from None
            known = f"{value!r}+/-{sigma!r}"
        fields[f"prior_{axis}"] = known
    return fields


def parse_prior(name, text):
    """Values and standard deviations of the axes that a prior option gives.

    Parameters
    ----------
    name : str
        prior.x ... prior.yaw or prior.transform.
    text : str
        ``VALUE+/-SIGMA`` for an axis; ``X Y Z ROLL PITCH YAW +/- SIGMA_TRANSLATION SIGMA_ROTATION``
        for the transform. Metres and radians, or with units (m, cm, mm, rad, deg). Empty for
        nothing.

    Returns
    -------
    dict
        Axis name to (value, sigma), in m or rad.

    Raises
    ------
    ConfigError
    """
    if not text:
        return {}
    axis = name.removeprefix("prior.")
    axes = tuple(AXIS_UNITS) if axis == "transform" else (axis,)
    expected = (
        "X Y Z ROLL PITCH YAW+/-SIGMA_TRANSLATION SIGMA_ROTATION"
        if axis == "transform"
        else "VALUE+/-SIGMA"
    )
    values, plus_minus, sigmas = text.replace("±", "+/-").partition("+/-")
    values, sigmas = values.split(), sigmas.split()
    if axis == "transform" and len(sigmas) == 2:
        sigmas = [sigmas[0]] * 3 + [sigmas[1]] * 3
    if not plus_minus or len(values) != len(axes) or len(sigmas) != len(axes):
        raise ConfigError(f"{name} must be {expected}, with how sure that is; got {text!r}")
    prior = {}
    for axis, value, sigma in zip(axes, values, sigmas, strict=True):
        unit = AXIS_UNITS[axis]
        prior[axis] = (_quantity(name, value, unit), _quantity(name, sigma, unit))
        if not prior[axis][1] > 0:
            raise ConfigError(f"{name} needs a standard deviation above 0; got {text!r}")
        if unit == "rad" and abs(prior[axis][0]) > 2 * math.pi:
            raise ConfigError(
                f"{name} is in radians unless it says deg; got {value!r}: write {value}deg"
            )
    return prior


def _quantity(name, text, unit):
    match = _QUANTITY.fullmatch(text)
    if not match or (match[2] or unit) not in _IN_SI[unit]:
        raise ConfigError(f"{name} must be numbers in {' or '.join(_IN_SI[unit])}; got {text!r}")
    return float(match[1]) * _IN_SI[unit][match[2] or unit]


def _prior(axis, unit):
    example = "1.85+/-0.02 or 185cm+/-2cm" if unit == "m" else "-90deg+/-2deg"
    return option(
        "",
        f"What is known of {axis} of the child sensor in the parent sensor's frame: VALUE+/-SIGMA, such as {example}. Empty for nothing.",
        unit=unit,
        name=f"prior.{axis}",
        parse=parse_prior,
    )


@dataclass(frozen=True)
class CalibratorConfig(OptionSet):
    """Options of the engine: the same for the node, the replay of bags, files and Python."""

    method: str = option(
        "dnlo",
        "Solver; dnlo rejects outliers, adaptive models the noise and needs no reference, the others use every pair.",
        choices=tuple(METHODS),
    )
    reference: str = option(
        "auto",
        "Which poses form motion pairs: A (all against the first), B<n> (against the n-th before), C<n> (segments of n), or auto "
        "(one from which the noise of these trajectories promises the least error).",
        pattern=REFERENCE_PATTERN,
    )
    backend: str = option(
        "fast",
        "fast is the quadratic-form solver; ipopt the paper's CasADi + Ipopt formulation.",
        choices=BACKENDS,
    )
    threshold: float = option(
        0.01,
        "DNLO: pairs whose cost exceeds this are outliers (c of eq. 5).",
        unit="m^2",
        minimum=1e-12,
        maximum=1e6,
    )
    min_inlier_fraction: float = option(
        0.5,
        "DNLO: share of the pairs that always counts as inliers (d of eq. 5 over the pairs).",
        minimum=0.0,
        maximum=1.0,
    )
    min_pairs: int = option(
        10, "Fewest synchronised pose pairs to solve with.", minimum=3, maximum=1_000_000
    )
    max_pairs: int = option(
        5000, "Most synchronised pose pairs kept.", minimum=10, maximum=100_000_000
    )
    keyframe_min_translation: float = option(
        0.0, "Keep a pose pair when the parent sensor has moved this far since the last one kept, or turned min_rotation.",
        unit="m", minimum=0.0, maximum=100.0, name="keyframe.min_translation",
    )  # fmt: skip
    keyframe_min_rotation: float = option(
        0.0, "Keep a pose pair when the parent sensor has turned this far since the last one kept, or moved min_translation.",
        unit="rad", minimum=0.0, maximum=math.pi, name="keyframe.min_rotation",
    )  # fmt: skip
    keyframe_min_interval: float = option(
        0.0,
        "Time between pose pairs that are kept.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
        name="keyframe.min_interval",
    )
    max_gap: float = option(
        0.5,
        "Longest time between two poses of a stream that interpolation may bridge.",
        unit="s",
        minimum=1e-3,
        maximum=60.0,
    )
    time_offset: float | str = option(
        0.0,
        "Added to the child's stamps to get the parent's clock; estimate finds it from how both streams turn.",
        unit="s",
        words=("estimate",),
        minimum=-1e9,
        maximum=1e9,
    )
    scale: str | float = option(
        "none",
        "Factor from the child's lengths to metres; estimate finds it, auto does so where it differs from 1 beyond doubt.",
        words=("none", "auto", "estimate"),
        minimum=1e-6,
        maximum=1e6,
    )
    prior_x: str = _prior("x", "m")
    prior_y: str = _prior("y", "m")
    prior_z: str = _prior("z", "m")
    prior_roll: str = _prior("roll", "rad")
    prior_pitch: str = _prior("pitch", "rad")
    prior_yaw: str = _prior("yaw", "rad")
    prior_transform: str = option(
        "",
        "What is known of the whole pose: X Y Z ROLL PITCH YAW+/-SIGMA_TRANSLATION SIGMA_ROTATION, such as "
        "0.4 0 1.85 0 0 -90deg+/-0.05 5deg. Empty for nothing.",
        name="prior.transform",
        parse=parse_prior,
    )
    parent_frame: str = option(
        "", "Name of the parent sensor's frame; empty takes it from the messages.", read_only=True
    )
    child_frame: str = option(
        "", "Name of the child sensor's frame; empty takes it from the messages.", read_only=True
    )

    def prior(self):
        """What is known beforehand: axis name to (value, sigma), in m and rad; a single axis goes
        before the transform.
        """
        known = {}
        for name in ("transform", *AXIS_UNITS):
            known |= parse_prior(f"prior.{name}", getattr(self, f"prior_{name}"))
        return known


@dataclass(frozen=True)
class NodeConfig(OptionSet):
    """Options that only the node has."""

    solve_period: float = option(
        2.0, "Time between solves.", unit="s", minimum=0.05, maximum=3600.0
    )
    parent_type: str = option(
        "auto",
        "Message type of parent_odom; auto looks at the publisher.",
        choices=POSE_TYPES,
        read_only=True,
    )
    child_type: str = option(
        "auto",
        "Message type of child_odom; auto looks at the publisher.",
        choices=POSE_TYPES,
        read_only=True,
    )
    output_directory: str = option(
        "",
        "Where ~/save and the end of the node write the result files, and the journal is; empty for nowhere.",
    )
    journal: str = option(
        "new",
        "The session on disk, in journal/ of output_directory, so that a crash loses less than a second of it: new begins a session "
        "and keeps the one before aside, resume goes on with the one there.",
        choices=("new", "resume", "off"),
        read_only=True,
    )
    publish_tf: bool = option(
        False,
        "Broadcast the result on /tf_static once all of it is observable; leave it off where the robot's description has this edge.",
    )
