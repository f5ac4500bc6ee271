"""What a report shows beside the result: residuals, paths, excitation, other answers, and what the
streams show before any solve.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.alignment.angular_rates import angular_rates
from hand_eye_calib.alignment.scale import child_scaled
from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.checks.streams import are_gaps
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.answers import Answer, OtherAnswers, compare_answers
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs, synchronise
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import CrossCheck
from hand_eye_calib.stats import median

# Most samples of the angular rates, and the shortest window of each (s).
_MAX_RATES, _MIN_WINDOW_S = 1500, 0.2

# Motions of both streams are compared over these times (s), the shorter ones only if poses are too
# rare for the longer; at most so many, and at least so many.
_LAGS_S, _MAX_MOTIONS, _MIN_MOTIONS = (3.0, 1.0, 0.4), 400, 12

# Smallest rotation (rad) whose axis means something.
_HAS_AXIS = float(np.radians(2.0))


@dataclass(frozen=True)
class ResidualView:
    """Residual of each of K motion pairs at the time of its end from the first pose, s: lengths in
    m and rad, whether the method rejected it (of the adaptive estimator: jumps), and the reference
    of the pairs.
    """

    times_s: FloatArray
    translation_m: FloatArray
    rotation_rad: FloatArray
    is_outlier: BoolArray
    reference: str


@dataclass(frozen=True)
class Tracks:
    """Paths (N, 3), m, of the parent sensor in its world, or of the sensor that has positions alone
    in that of its positions: its own, and from the poses of the other one through the result.
    """

    times_s: FloatArray
    parent: FloatArray
    child: FloatArray


@dataclass(frozen=True, kw_only=True)
class StreamView:
    """What the streams show before any solve, on the parent's clock and in its unit of length;
    first the parent, then the child.

    Attributes
    ----------
    quantity : {"angular rate", "speed"}
        What is shown over time: the speed if one sensor has positions alone.
    rates : 2 x (times_s, rates)
        rad/s or m/s; NaN in gaps.
    spans_s : 2 x (M, 2) arrays
        Start and end of the times in which each stream has poses, without longer gaps.
    lag_s : float
        Duration of the motions that are compared.
    angles : (K, 2) array
        Rotation angles of the motions, rad.
    along_axis : (L, 2) array
        Translations along the rotation axis, m, of the motions that have one.
    rms_translation : float
        Root mean square translation of the parent's motions, m.
    is_whole : bool
        Whether both sensors have poses. Otherwise no motions are compared.
    """

    quantity: str
    rates: tuple[tuple[FloatArray, FloatArray], ...]
    spans_s: tuple[FloatArray, ...]
    lag_s: float
    angles: FloatArray
    along_axis: FloatArray
    rms_translation: float
    is_whole: bool

    @property
    def apart(self) -> float:
        """Median difference of both rates (rad/s) or speeds (m/s); NaN if they never overlap."""
        (times, of_parent), (others, of_child) = self.rates
        shared = (times >= others[0]) & (times <= others[-1]) if len(others) else times < 0
        apart = np.abs(of_parent - np.interp(times, others, of_child))[shared]
        return median(apart[np.isfinite(apart)])


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Everything that the figures show beside the Calibration itself: the poses with the child's in
    the parent's unit of length; answers from growing parts of the recording (``convergence``), from
    other methods and references (``comparison``) and from both halves alone, with the cross-check
    of the result with them; whether the parent has positions alone; and both streams as they were
    read, if they are known.
    """

    pose_pairs: PosePairs
    residuals: ResidualView
    tracks: Tracks
    excitation: Excitation
    convergence: tuple[Answer, ...]
    comparison: tuple[Answer, ...]
    halves: tuple[Answer, ...]
    cross_check: CrossCheck
    streams: StreamView
    has_positions_of_parent: bool
    as_read: Mapping[str, Trajectory]


def gather(
    calibration: Calibration,
    config: CalibratorConfig,
    pose_pairs: PosePairs,
    streams: Mapping[str, Trajectory] | None = None,
) -> Evidence:
    """Collect the evidence; this solves some twenty times.

    Parameters
    ----------
    calibration : Calibration
        The result.
    config : CalibratorConfig
        The options that gave it.
    pose_pairs : PosePairs
        The poses that gave it, on one clock, each stream in its own unit of length.
    streams : mapping, optional
        "parent" and "child" to the Trajectory as it was read; the synchronised poses without it.

    Returns
    -------
    Evidence
    """
    answers = OtherAnswers(calibration, config, pose_pairs)
    scaled = child_scaled(pose_pairs, calibration.scale)
    comparison, halves = answers.other_methods(), answers.halves()
    residuals = calibration.residuals()
    rotating = scaled
    of_parent = config.parent_measures == "positions"
    if of_parent:
        rotating = PosePairs(scaled.stamps_ns, scaled.Ts_cw_c, scaled.Ts_pw_p)
    return Evidence(
        pose_pairs=scaled,
        residuals=ResidualView(
            _seconds(scaled, residuals.end_ns),
            residuals.translation_m,
            residuals.rotation_rad,
            ~residuals.is_inlier,
            calibration.reference if METHODS[calibration.method].uses_reference else "B1",
        ),
        tracks=_tracks(calibration, scaled, of_parent),
        excitation=excitation(rotating),
        convergence=answers.growing(),
        comparison=comparison,
        halves=halves,
        cross_check=compare_answers(
            calibration,
            [other.calibration for other in comparison],
            [half.calibration for half in halves],
        ),
        streams=_streams(calibration, config, scaled, streams),
        has_positions_of_parent=of_parent,
        as_read=streams or {},
    )


def view_streams(parent: Trajectory, child: Trajectory, max_gap_s: float) -> StreamView:
    """The StreamView of two trajectories on one clock, in one unit of length."""
    start_ns = min(parent.stamps_ns[0], child.stamps_ns[0])
    step_s = max(
        parent.interval_s,
        child.interval_s,
        max(parent.duration_s, child.duration_s) / _MAX_RATES,
    )
    has_rates = parent.has_rotations and child.has_rotations
    is_whole = has_rates and parent.has_positions and child.has_positions
    rates, spans = [], []
    for stream in (parent, child):
        window_s = max(3 * step_s, _MIN_WINDOW_S)
        found = angular_rates(stream, window_s, step_s, max_gap_s, of_speed=not has_rates)
        steps = np.arange(len(found.values)) * step_s
        rates.append(((found.start_ns - start_ns) * 1e-9 + steps, found.values))
        gaps = np.flatnonzero(are_gaps(np.diff(stream.stamps_ns) * 1e-9, max_gap_s))
        edges = stream.stamps_ns[np.sort(np.r_[0, gaps, gaps + 1, len(stream) - 1])]
        spans.append((edges.reshape(-1, 2) - start_ns) * 1e-9)
    lag_s, angles, along_axis, rms_translation = _compared_motions(
        synchronise(parent, child, max_gap_s) if is_whole else PosePairs.empty()
    )
    return StreamView(
        quantity="angular rate" if has_rates else "speed",
        is_whole=is_whole,
        rates=tuple(rates),
        spans_s=tuple(spans),
        lag_s=lag_s,
        angles=angles,
        along_axis=along_axis,
        rms_translation=rms_translation,
    )


def _seconds(pose_pairs: PosePairs, stamps_ns: IntArray) -> FloatArray:
    """Seconds from the first pose."""
    return (stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9


def _tracks(calibration: Calibration, pose_pairs: PosePairs, of_parent: bool) -> Tracks:
    """Both paths, the child's world aligned with the parent's: by the mean over all poses, or by
    the paths if one sensor has positions alone.
    """
    times_s = _seconds(pose_pairs, pose_pairs.stamps_ns)
    if calibration.measured == "positions":
        poses, measured = pose_pairs.Ts_pw_p @ calibration.T_parent_child, pose_pairs.Ts_cw_c
        if of_parent:
            poses, measured = pose_pairs.Ts_cw_c @ calibration.T_child_parent, pose_pairs.Ts_pw_p
        path, positions = poses[:, :3, 3], measured[:, :3, 3]
        path = path - path.mean(axis=0)
        rotation = se3.nearest_rotation((positions - positions.mean(axis=0)).T @ path)
        path = path @ rotation.T + positions.mean(axis=0)
        parent, child = (positions, path) if of_parent else (path, positions)
        return Tracks(times_s, parent - positions[0], child - positions[0])
    Ts_cw_p = pose_pairs.Ts_cw_c @ calibration.T_child_parent
    rotations = pose_pairs.Ts_pw_p[:, :3, :3] @ np.swapaxes(Ts_cw_p[:, :3, :3], 1, 2)
    parent = pose_pairs.Ts_pw_p[:, :3, 3]
    child = Ts_cw_p[:, :3, 3] @ se3.nearest_rotation(rotations.mean(axis=0)).T
    child = child + np.median(parent - child, axis=0)
    return Tracks(times_s, parent - parent[0], child - parent[0])


def _streams(
    calibration: Calibration,
    config: CalibratorConfig,
    pose_pairs: PosePairs,
    streams: Mapping[str, Trajectory] | None,
) -> StreamView:
    if streams:
        child = streams["child"].shifted(calibration.time_offset_s).scaled(calibration.scale)
        return view_streams(streams["parent"], child, config.max_gap)
    parent, child = (
        Trajectory(pose_pairs.stamps_ns, poses, measures=measures.replace("auto", "poses"))
        for poses, measures in (
            (pose_pairs.Ts_pw_p, config.parent_measures),
            (pose_pairs.Ts_cw_c, config.child_measures),
        )
    )
    return view_streams(parent, child, config.max_gap)


def _compared_motions(
    pose_pairs: PosePairs,
) -> tuple[float, FloatArray, FloatArray, float]:
    """Lag, rotation angles (K, 2) and translations along the axis (L, 2) of motions of both
    sensors, and the root mean square translation of the parent's.
    """
    if not len(pose_pairs):
        return _LAGS_S[0], np.empty((0, 2)), np.empty((0, 2)), 0.0
    for lag_s in _LAGS_S:
        start, end = _spans(pose_pairs, lag_s)
        if len(start) >= _MIN_MOTIONS:
            break
    chosen = np.unique(
        np.linspace(0, max(len(start) - 1, 0), min(len(start), _MAX_MOTIONS)).astype(int)
    )
    angles, along_axis, lengths = [], [], []
    for poses in (pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c):
        motions = se3.inverse(poses[start[chosen]]) @ poses[end[chosen]]
        vectors, translations = se3.rotation_log(motions[:, :3, :3]), motions[:, :3, 3]
        angles.append(np.linalg.norm(vectors, axis=1))
        lengths.append(np.linalg.norm(translations, axis=1))
        products = np.einsum("ki,ki->k", vectors, translations)
        along_axis.append(products / np.maximum(angles[-1], 1e-12))
    both_angles = np.stack(angles, axis=1)
    have_axis = (both_angles > _HAS_AXIS).all(axis=1)
    rms_translation = float(np.sqrt(np.mean(lengths[0] ** 2))) if len(chosen) else 0.0
    return lag_s, both_angles, np.stack(along_axis, axis=1)[have_axis], rms_translation


def _spans(pose_pairs: PosePairs, span_s: float) -> tuple[IntArray, IntArray]:
    """Indices of poses, and of those about ``span_s`` later."""
    times_s = _seconds(pose_pairs, pose_pairs.stamps_ns)
    ends = np.searchsorted(times_s, times_s + span_s - 1e-9)
    start = np.flatnonzero(ends < len(times_s))
    return start, np.maximum(ends[start], start + 1)
