"""What there is to see in each figure of the report, in words and numbers."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.engine.answers import Answer
from hand_eye_calib.engine.evidence import Evidence, StreamView
from hand_eye_calib.methods import METHODS
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import amount, angle, counted, length, listing, share

Caption = Callable[[Calibration, Evidence], str]

TITLES = {
    "trajectories": "Both trajectories, aligned",
    "residuals": "Residuals over time",
    "convergence": "Convergence",
    "excitation": "Excitation",
    "methods": "Other methods and references",
    "halves": "The two halves of the recording",
    "streams": "Both streams before any solve",
}

# Figures that streams of other kinds do not have.
_OF_POSES_ALONE = {"methods": ("poses",), "trajectories": ("poses", "positions")}

# Two results disagree when they are this many standard deviations apart.
_DISAGREE = 3.0

# A recording is long enough when from its first part on the result stays within this many standard
# deviations of the final one.
_SETTLED = 3.0


def time_axis(duration_s: float) -> tuple[float, str]:
    """Factor and name of the unit in which the time of a recording is shown."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def figures_of(calibration: Calibration) -> list[str]:
    """Names of the figures in :data:`TITLES` that a result of its kind has."""
    kind = calibration.measured
    return [name for name in TITLES if kind in _OF_POSES_ALONE.get(name, (kind,))]


def measured_axes(calibration: Calibration) -> BoolArray:
    """Mask (6,) of the axes that streams of this kind can show."""
    silent = {"rotations": "xyz", "positions": AXES[3:]}.get(calibration.measured, ())
    return np.array([name not in silent for name in AXES])


def captions(calibration: Calibration, evidence: Evidence) -> dict[str, str]:
    """A caption for each figure of a result."""
    return {name: _CAPTIONS[name](calibration, evidence) for name in figures_of(calibration)}


def _of_trajectories(calibration: Calibration, evidence: Evidence) -> str:
    tracks = evidence.tracks
    apart = np.linalg.norm(tracks.parent - tracks.child, axis=1)
    farthest = int(np.argmax(apart))
    path_m = float(np.linalg.norm(np.diff(tracks.parent, axis=0), axis=1).sum())
    factor, unit = time_axis(tracks.times_s[-1])
    names, drifting = (calibration.parent_frame, calibration.child_frame), "both odometries"
    if calibration.measured == "positions":
        names = names if evidence.has_positions_of_parent else names[::-1]
        drifting = "the odometry"
    return (
        f"The path of {names[0]}, {length(path_m)} long, and the same path "
        f"computed from the poses of {names[1]} and the result. Half of the time "
        f"they are within {length(float(np.median(apart)))} of each other, and at most "
        f"{length(apart[farthest])} apart, at {tracks.times_s[farthest] * factor:.1f} {unit}. "
        f"That includes drift and jumps of {drifting}."
    )


def _of_residuals(calibration: Calibration, evidence: Evidence) -> str:
    residuals = evidence.residuals
    n_out = int(residuals.is_outlier.sum())
    what = f"motion pairs ({residuals.reference})"
    if calibration.measured == "positions":
        what = "distances from one position to the next"
    sizes = residual_sizes(calibration, evidence)
    text = (
        f"Half of the {len(residuals.times_s):,} {what} agree with the result to "
        f"{_each(sizes, np.median)}"
    )
    if not n_out:
        return f"{text}, all of them to {_each(sizes, np.max)}. There are no outliers."
    axis, values = next(iter(sizes.items()))
    largest = int(np.argmax(np.where(residuals.is_outlier, values, -1)))
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    return (
        f"{text}; {n_out:,} ({share(n_out / len(residuals.times_s))}) were rejected as outliers, "
        f"the largest {amount(axis, values[largest])} at "
        f"{residuals.times_s[largest] * factor:.1f} {unit}."
    )


def residual_sizes(calibration: Calibration, evidence: Evidence) -> dict[str, FloatArray]:
    """Lengths of the residuals that streams of this kind have: of translations under "x", of
    rotations under "yaw".
    """
    residuals = evidence.residuals
    both = {"x": residuals.translation_m, "yaw": residuals.rotation_rad}
    seen = measured_axes(calibration)
    return {axis: values for axis, values in both.items() if seen[AXES.index(axis)]}


def _each(sizes: Mapping[str, FloatArray], of: Callable[[FloatArray], FloatArray]) -> str:
    return listing([amount(axis, float(of(values))) for axis, values in sizes.items()])


def _of_convergence(calibration: Calibration, evidence: Evidence) -> str:
    estimates = evidence.convergence
    if len(estimates) < 3:
        return "The recording is too short to be divided into parts."
    known = np.isfinite(calibration.sigmas) & measured_axes(calibration)
    if not known.any():
        return "No axis is observable, however much of the recording is used."
    last = _last_change(calibration, estimates, known)
    first = _settled_from(calibration, estimates, known)
    factor, unit = time_axis(estimates[-1].until_s)
    if first == len(estimates) - 1:
        names = [name for name, is_known in zip(AXES, known, strict=True) if is_known]
        return (
            f"The result had not settled within its own uncertainty before the end "
            f"({listing(names)}): record longer. {last} Shaded: one standard "
            f"deviation.{_downsampled(estimates)}"
        )
    return (
        f"From {estimates[first].until_s * factor:.1f} {unit} on, the result stays within "
        f"{_SETTLED:g} of its standard deviations (shaded: one) of the final result. "
        f"{last}{_downsampled(estimates)}"
    )


def _settled_from(calibration: Calibration, estimates: Sequence[Answer], known: BoolArray) -> int:
    """Index of the estimate from which on all lie near the result."""
    moved = np.array(
        [deviation(one.calibration.T_parent_child, calibration.T_parent_child) for one in estimates]
    )[:, known]
    sigmas = np.array([one.calibration.sigmas for one in estimates])[:, known]
    near = (np.abs(moved) <= _SETTLED * np.where(np.isfinite(sigmas), sigmas, 0)).all(axis=1)
    return 0 if near.all() else len(near) - int(np.argmin(near[::-1]))


def _last_change(calibration: Calibration, estimates: Sequence[Answer], known: BoolArray) -> str:
    late = estimates[max(len(estimates) * 7 // 10 - 1, 0)]
    moved = deviation(late.calibration.T_parent_child, calibration.T_parent_child)
    rest = 1 - late.until_s / estimates[-1].until_s
    return f"The last {rest:.0%} of the recording changed the result by {_largest(moved, known)}."


def _of_excitation(calibration: Calibration, evidence: Evidence) -> str:
    seen, rotations = evidence.excitation, evidence.rotations
    if not len(rotations.times_s):
        return "The poses are too far apart to show the rotations."
    over = np.degrees(np.percentile(np.abs(rotations.vectors), 95, axis=0))
    angles = [f"{angle:.1f}° in {name}" for angle, name in zip(over, AXES[3:], strict=True)]
    least = "xyz"[int(np.argmax(np.abs(seen.worst)))]
    text = (
        f"Rotation within {rotations.span_s:.1f} s: up to {listing(angles)} (95 % of the time "
        "less)."
    )
    if calibration.measured == "rotations":
        return f"{text} Only rotations about two axes and more show the whole orientation."
    return (
        f"{text} The lever arm along {least} is observed least: an error of 1 cm in it moves a "
        f"motion by "
        f"{seen.worst_gain:.2g} cm, an error of 1 cm along the best observed axis by "
        f"{seen.gain.max():.2g} cm. Rotations inside the grey band say little about a lever arm."
    )


def _of_methods(calibration: Calibration, evidence: Evidence) -> str:
    if not evidence.comparison:
        return "The recording is too short to compare methods."
    known = np.isfinite(calibration.sigmas)
    if not known.any():
        return "No axis is observable, so there is nothing to compare."
    robust: dict[str, FloatArray] = {}
    others: dict[str, FloatArray] = {}
    for one in evidence.comparison:
        # What a method itself calls unobservable is not held against it.
        moved = np.where(
            np.isfinite(one.calibration.sigmas),
            deviation(one.calibration.T_parent_child, calibration.T_parent_child),
            0.0,
        )
        group = robust if METHODS[one.calibration.method].rejects_outliers else others
        group[one.label] = moved
    texts = []
    if robust:
        worst = np.max(np.abs(list(robust.values())), axis=0)
        texts.append(
            "The methods that reject outliers differ from the result by at most "
            f"{_largest(worst, known)}"
        )
    if others:
        label = max(others, key=lambda name: _distance(others[name], known))
        texts.append(f"those that use every pair by {_largest(others[label], known)} ({label})")
    return (
        "; ".join(texts) + ". B<n> pairs each pose with the n-th before it. Bars: one standard "
        "deviation; triangles lie beyond the axis; shaded: one standard deviation of the result."
    )


def _of_halves(calibration: Calibration, evidence: Evidence) -> str:
    if len(evidence.halves) < 2:
        return "The recording is too short to be divided into halves."
    first, second = (half.calibration for half in evidence.halves)
    known = np.isfinite(first.sigmas) & np.isfinite(second.sigmas) & measured_axes(calibration)
    if not known.any():
        return "No axis is observable in both halves."
    apart = deviation(first.T_parent_child, second.T_parent_child)
    joint = np.hypot(first.sigmas, second.sigmas)
    hidden = ~known & np.isfinite(calibration.sigmas) & measured_axes(calibration)
    less = [name for name, is_hidden in zip(AXES, hidden, strict=True) if is_hidden]
    missing = f" Half of the recording does not determine {listing(less)}." if less else ""
    return (
        f"From each half alone, without priors: they differ by {_largest(apart, known)}, "
        f"{_judged(apart[known], joint[known], np.array(AXES)[known].tolist())}.{missing}"
        f"{_downsampled(evidence.halves)}"
    )


def _judged(apart: FloatArray, joint: FloatArray, names: Sequence[str]) -> str:
    """Whether a difference is chance, by the standard deviations."""
    ratio = np.abs(apart) / np.maximum(joint, 1e-12)
    worst = int(np.argmax(ratio))
    if ratio[worst] > _DISAGREE:
        return (
            f"which is more than chance: {names[worst]} by {ratio[worst]:.1f} standard deviations. "
            "Do not trust the result beyond that difference"
        )
    return (
        f"which may be chance: the largest, {names[worst]}, is {ratio[worst]:.1f} standard "
        "deviations"
    )


def of_streams(seen: StreamView) -> str:
    """Caption of the figure of both streams."""
    gaps = [counted(len(spans) - 1, "gap") for spans in seen.spans_s]
    bars = (
        f"The bars below the curves show when there is data: {gaps[0]} in the parent stream, "
        f"{gaps[1]} in the child stream."
    )
    if not seen.is_whole:
        return f"{_WHAT_COINCIDES[seen.quantity]} {_half_of_the_time(seen)} {bars}"
    text = (
        "Two sensors on one rigid body have the same angular rate at every moment. Each motion "
        "rotates both by the same angle and moves both equally far along its rotation axis, "
        "however they are mounted. So the two curves must coincide, and the dots must lie on the "
        "line; on flat ground, where nothing moves along the axis, near zero. "
    )
    if not len(seen.angles):
        return text + "Here the streams have 0 motions in common: there is nothing to compare."
    apart = np.abs(np.diff(seen.angles, axis=1))
    text += (
        f"Here half of the {len(seen.angles)} motions over {seen.lag_s:g} s differ by less than "
        f"{angle(float(np.median(apart)))}"
    )
    if len(seen.along_axis):
        text += f" and {length(float(np.median(np.abs(np.diff(seen.along_axis, axis=1)))))}"
    return f"{text}. {bars}"


_WHAT_COINCIDES = {
    "angular rate": "Two sensors on one rigid body have the same angular rate at every moment, "
    "however they are mounted: the two curves must coincide, up to the bias of a gyroscope.",
    "speed": "Two points of one rigid body have the same speed while it does not rotate: the two "
    "curves must have the same course.",
}


def _half_of_the_time(seen: StreamView) -> str:
    if not np.isfinite(seen.apart):
        return "Here the streams never overlap."
    apart = length(seen.apart) if seen.quantity == "speed" else angle(seen.apart)
    return f"Here they differ by less than {apart}/s half of the time."


_CAPTIONS: dict[str, Caption] = {
    "trajectories": _of_trajectories,
    "residuals": _of_residuals,
    "convergence": _of_convergence,
    "excitation": _of_excitation,
    "methods": _of_methods,
    "halves": _of_halves,
    "streams": lambda calibration, evidence: of_streams(evidence.streams),
}


def _downsampled(estimates: Sequence[Answer]) -> str:
    """A remark if not all poses were used."""
    stride = max(one.stride for one in estimates)
    if stride == 1:
        return ""
    return (
        f" To save time, parts were downsampled to as few as one pose in {stride}; they are less "
        "certain for that."
    )


def _largest(difference: FloatArray, known: BoolArray) -> str:
    """The largest translation and rotation among the known axes."""
    texts = []
    for first in (0, 3):
        values = np.where(known, np.abs(difference), -1.0)[first : first + 3]
        index = int(np.argmax(values))
        if values[index] >= 0:
            name = AXES[first + index]
            texts.append(f"{amount(name, values[index])} ({name})")
    return listing(texts)


def _distance(difference: FloatArray, known: BoolArray) -> float:
    return float(np.linalg.norm(np.where(known, difference, 0.0)))
