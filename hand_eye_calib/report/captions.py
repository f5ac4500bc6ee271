"""What there is to see in each figure of the report, in words and numbers.

The verdict judges, by rules of its own; a caption says how large something is, and gives advice
only where the verdict is not USE.
"""

from collections.abc import Callable, Sequence

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.engine.answers import Answer
from hand_eye_calib.engine.evidence import Evidence, StreamView
from hand_eye_calib.report.plot import said_of_views
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.text import amount, angle, counted, length, listing, share

TITLES = {
    "views": "Both sensors in space",
    "trajectories": "Both trajectories, aligned",
    "residuals": "Residuals over time",
    "convergence": "Convergence",
    "answers": "Other methods, other references, and each half alone",
    "streams": "Both streams before any solve",
}

# Two results disagree, and a result has not settled, from so many standard deviations on.
_DISAGREE = 3.0

_WHAT_COINCIDES = {
    "angular rate": "Two sensors on one rigid body have the same angular rate at every moment, "
    "however they are mounted: the two curves must coincide, up to the bias of a gyroscope.",
    "speed": "Two points of one rigid body have the same speed while it does not rotate: the two "
    "curves must have the same course.",
}


def time_axis(duration_s: float) -> tuple[float, str]:
    """Factor and name of the unit in which the time of a recording is shown."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def measured_axes(calibration: Calibration) -> BoolArray:
    """Mask (6,) of the axes that streams of this kind can show."""
    silent = {"rotations": "xyz", "positions": AXES[3:]}.get(calibration.measured, ())
    return np.array([name not in silent for name in AXES])


def known_axes(calibration: Calibration) -> BoolArray:
    """Mask (6,) of the axes that the result knows."""
    known: BoolArray = np.isfinite(calibration.sigmas) & measured_axes(calibration)
    return known


def captions(calibration: Calibration, evidence: Evidence) -> dict[str, str]:
    """A caption for each figure that a result of its kind has, by the names in :data:`TITLES`."""
    makers: dict[str, Callable[[Calibration, Evidence], str]] = {
        "views": lambda calibration, _: said_of_views(calibration),
        "trajectories": _of_trajectories,
        "residuals": _of_residuals,
        "convergence": _of_convergence,
        "answers": _of_answers,
    }
    if calibration.measured == "rotations":
        del makers["trajectories"], makers["views"]
    texts = {name: make(calibration, evidence) for name, make in makers.items()}
    return texts | {"streams": of_streams(evidence.streams)}


def _of_trajectories(calibration: Calibration, evidence: Evidence) -> str:
    tracks = evidence.tracks
    apart = np.linalg.norm(tracks.parent - tracks.child, axis=1)
    path_m = float(np.linalg.norm(np.diff(tracks.parent, axis=0), axis=1).sum())
    names = (calibration.parent_frame, calibration.child_frame)
    if calibration.measured == "positions" and not evidence.has_positions_of_parent:
        names = names[::-1]
    at = _at(tracks.times_s[int(np.argmax(apart))], evidence)
    return (
        f"The path of {names[0]}, {length(path_m)} long, and the same path "
        f"computed from the poses of {names[1]} and the result. Half of the time "
        f"they are within {length(float(np.median(apart)))} of each other, and at most "
        f"{length(apart.max())} apart, {at}. That includes drift and jumps of the odometry."
    )


def _at(seconds: float, evidence: Evidence) -> str:
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    return f"at {seconds * factor:.1f} {unit}"


def _of_residuals(calibration: Calibration, evidence: Evidence) -> str:
    residuals, sizes = evidence.residuals, residual_sizes(calibration, evidence)
    n_out = int(residuals.is_outlier.sum())
    what = f"motion pairs ({residuals.reference})"
    if calibration.measured == "positions":
        what = "distances from one position to the next"

    def each(of: Callable[[FloatArray], FloatArray]) -> str:
        return listing([amount(axis, float(of(values))) for axis, values in sizes.items()])

    text = f"Half of the {len(residuals.times_s):,} {what} agree with the result to "
    if not n_out:
        return f"{text}{each(np.median)}, all of them to {each(np.max)}. There are no outliers."
    axis, values = next(iter(sizes.items()))
    largest = int(np.argmax(np.where(residuals.is_outlier, values, -1)))
    return (
        f"{text}{each(np.median)}; {n_out:,} ({share(n_out / len(residuals.times_s))}) were "
        f"rejected as outliers, the largest {amount(axis, values[largest])} "
        f"{_at(residuals.times_s[largest], evidence)}."
    )


def residual_sizes(calibration: Calibration, evidence: Evidence) -> dict[str, FloatArray]:
    """Lengths of the residuals that streams of this kind have: of translations under "x", of
    rotations under "yaw".
    """
    residuals, seen = evidence.residuals, measured_axes(calibration)
    both = {"x": residuals.translation_m, "yaw": residuals.rotation_rad}
    return {axis: values for axis, values in both.items() if seen[AXES.index(axis)]}


def _of_convergence(calibration: Calibration, evidence: Evidence) -> str:
    estimates, known = evidence.convergence, known_axes(calibration)
    if len(estimates) < 3:
        return "The recording is too short to be divided into parts."
    if not known.any():
        return "No axis is observable, however much of the recording is used."
    moved = relative_to(calibration, [one.calibration for one in estimates])
    sigmas = np.array([one.calibration.sigmas for one in estimates])
    limits = _DISAGREE * np.where(np.isfinite(sigmas), sigmas, 0)
    near = np.all((np.abs(moved) <= limits)[:, known], axis=1)
    late = max(len(estimates) * 7 // 10 - 1, 0)
    rest = 1 - estimates[late].until_s / estimates[-1].until_s
    text = (
        f"The last {rest:.0%} of the recording changed the result by "
        f"{_largest(moved[late], known)}. Shaded: one standard deviation.{_downsampled(estimates)}"
    )
    if not near[:-1].any() and calibration.verdict is not Verdict.USE:
        return f"The result had not settled before the end: record longer. {text}"
    return text


def _of_answers(calibration: Calibration, evidence: Evidence) -> str:
    known = known_axes(calibration)
    if not (evidence.comparison or evidence.halves):
        return "The recording is too short to compare methods, or to be divided into halves."
    if not known.any():
        return "No axis is observable, so there is nothing to compare."
    texts = []
    if evidence.comparison:
        others = [one.calibration for one in evidence.comparison]
        moved = np.abs(relative_to(calibration, others))
        # What a method itself calls unobservable is not held against it.
        moved[~np.isfinite([one.sigmas for one in others])] = 0.0
        farthest = int(np.argmax(np.linalg.norm(moved[:, known], axis=1)))
        texts.append(
            f"Half of the other methods and references are within "
            f"{_largest(np.median(moved, axis=0), known)} of the result; the farthest, "
            f"{evidence.comparison[farthest].label}, is {_largest(moved[farthest], known)} away."
        )
    if len(evidence.halves) == 2:
        first, second = (half.calibration for half in evidence.halves)
        shown = np.isfinite(first.sigmas) & np.isfinite(second.sigmas) & known
        apart = deviation(first.T_parent_child, second.T_parent_child)
        ratios = np.where(shown, np.abs(apart) / np.hypot(first.sigmas, second.sigmas), 0.0)
        worst = int(np.argmax(ratios))
        text = (
            f"The two halves alone differ by {_largest(apart, shown)}; the largest, {AXES[worst]}, "
            f"is {ratios[worst]:.1f} standard deviations"
        )
        if ratios[worst] > _DISAGREE and calibration.verdict is not Verdict.USE:
            text += ", more than chance. Do not trust the result beyond that difference"
        text = text if shown.any() else "No axis is observable in both halves"
        texts.append(f"{text}.{_downsampled(evidence.halves)}")
    return (
        f"{' '.join(texts)} B<n> pairs each pose with the n-th before it. Bars: one standard "
        "deviation; triangles lie beyond the axis; shaded: one standard deviation of the result."
    )


def of_streams(seen: StreamView) -> str:
    """Caption of the figure of both streams."""
    gaps = [counted(len(spans) - 1, "gap") for spans in seen.spans_s]
    bars = (
        f"The bars below the curves show when there is data: {gaps[0]} in the parent stream, "
        f"{gaps[1]} in the child stream."
    )
    if not seen.is_whole:
        apart = length(seen.apart) if seen.quantity == "speed" else angle(seen.apart)
        differ = f"Here they differ by less than {apart}/s half of the time."
        if not np.isfinite(seen.apart):
            differ = "Here the streams never overlap."
        return f"{_WHAT_COINCIDES[seen.quantity]} {differ} {bars}"
    text = (
        "Two sensors on one rigid body have the same angular rate at every moment. Each motion "
        "rotates both by the same angle and moves both equally far along its rotation axis, "
        "however they are mounted. So the two curves must coincide, and the dots must lie on the "
        "line; on flat ground, where nothing moves along the axis, near zero. "
    )
    if not len(seen.angles):
        return text + "Here the streams have 0 motions in common: there is nothing to compare."
    differences = [angle(float(np.median(np.abs(np.diff(seen.angles, axis=1)))))]
    if len(seen.along_axis):
        differences.append(length(float(np.median(np.abs(np.diff(seen.along_axis, axis=1))))))
    return (
        f"{text}Here half of the {len(seen.angles)} motions over {seen.lag_s:g} s differ by less "
        f"than {listing(differences)}. {bars}"
    )


def relative_to(calibration: Calibration, answers: Sequence[Calibration]) -> FloatArray:
    """Deviations (N, 6) of answers from the result, in m and rad."""
    return np.array([deviation(one.T_parent_child, calibration.T_parent_child) for one in answers])


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
