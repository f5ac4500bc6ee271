"""What a report shows beside the result: residuals, and the same question put to parts of the drive
and to other methods.

Everything is solved again by the engine, which is handed in: this room draws and does not solve.
Long drives are thinned before they are solved again, so that a report costs seconds.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.alignment.angular_rates import angular_rates
from hand_eye_calib.assessment.excitation import Excitation, excitation
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs, synchronise

# Methods the result is compared with, the most poses each of them gets, and references.
_COMPARED_METHODS = ("dnlo", "dnl", "park")
_COMPARED_ESTIMATOR = "adaptive"
_MOST_POSES_OF_OTHERS = 3_000
_COMPARED_BASELINES = (1, 5, 10, 20)
_FEWEST_POSES = 20

# Angular speeds are shown at most so many times, over at least this long each (s).
_MOST_RATES, _SHORTEST_WINDOW_S = 1500, 0.2

# Motions of both streams that are compared: over this long (s; where poses are rarer, over shorter
# times), at most so many.
_LAGS_S, _MOST_MOTIONS, _FEWEST_MOTIONS = (3.0, 1.0, 0.4), 400, 12

# Where a sensor turns less (rad), the axis it turns about is chance.
_HAS_AXIS = np.radians(2.0)

# Time over which turning is shown (s); where poses are rarer than that, from one to the next.
_TURNING_S = 2.0


@dataclass(frozen=True)
class Estimate:
    """One of several answers to the same question.

    Attributes
    ----------
    label : str
        Method and reference, or part of the drive.
    until_s : float
        Seconds from the first pose to the last one used.
    calibration : Calibration
    stride : int
        Every so many-th pose was used.
    """

    label: str
    until_s: float
    calibration: Calibration
    stride: int = 1


@dataclass(frozen=True)
class Residuals:
    """How far each motion pair is from agreeing with the result.

    Attributes
    ----------
    times_s : (K,) array
        End of each pair, from the first pose.
    translation_m, rotation_rad : (K,) arrays
        Lengths.
    is_outlier : (K,) bool array
        Pairs (of the adaptive estimator: jumps) that the method left out.
    reference : str
        Of the pairs.
    """

    times_s: np.ndarray
    translation_m: np.ndarray
    rotation_rad: np.ndarray
    is_outlier: np.ndarray
    reference: str


@dataclass(frozen=True)
class Turning:
    """Rotation vectors (N, 3) of the parent sensor over ``span_s``, in its own axes, rad, from
    ``times_s`` on.
    """

    times_s: np.ndarray
    vectors: np.ndarray
    span_s: float


@dataclass(frozen=True)
class Tracks:
    """Ways of the parent sensor in its world: its own (N, 3), and the one that the child's poses
    give through the result.
    """

    times_s: np.ndarray
    parent: np.ndarray
    child: np.ndarray


@dataclass(frozen=True)
class StreamsSeen:
    """What the streams say before any solve, on the parent's clock and in its unit of length; first
    the parent, then the child.

    Attributes
    ----------
    rates : 2 x (times_s, rates)
        Angular speeds, rad/s; nan in gaps.
    spans_s : 2 x (M, 2) arrays
        When each stream has poses, without longer gaps.
    lag_s : float
        How long the motions compared are.
    angles, slides : (K, 2), (L, 2) arrays
        Rotation angles of the motions, rad, and how far each goes along the axis it turns about, m
        (of those that have one).
    moved_m : float
        Root mean square length of the parent's motions, m.
    """

    rates: tuple
    spans_s: tuple
    lag_s: float
    angles: np.ndarray
    slides: np.ndarray
    moved_m: float


@dataclass(frozen=True)
class Evidence:
    """Everything that the figures show, beside the Calibration itself.

    ``convergence`` are answers from growing parts of the drive, ``comparison`` from other methods
    and references, ``halves`` from the first and the second half alone: tuples of Estimate, without
    those that had too little data. ``as_read`` are the streams before they were synchronised,
    "parent" and "child" to Trajectory; it may be empty.
    """

    pose_pairs: PosePairs
    residuals: Residuals
    tracks: Tracks
    turning: Turning
    excitation: Excitation
    convergence: tuple
    comparison: tuple
    halves: tuple
    streams: StreamsSeen
    as_read: dict


def gather(calibration, config, pose_pairs, estimate, streams=None):
    """Collect the evidence.

    Parameters
    ----------
    calibration : Calibration
        The result.
    config : CalibratorConfig
        The options that gave it.
    pose_pairs : PosePairs
        The poses that gave it, on one clock, in their own scales.
    estimate : callable
        The engine: ``estimate(pose_pairs, config)`` gives a Calibration, or raises
        HandEyeCalibError.
    streams : mapping, optional
        "parent" and "child" to Trajectory, as they were read; the synchronised poses stand for them
        where they are left out.

    Returns
    -------
    Evidence
    """
    # Clock and scale are settled; every answer below is with those.
    settled = dataclasses.replace(
        config, time_offset=calibration.time_offset_s, scale=calibration.scale, backend="fast"
    )
    without_prior = dataclasses.replace(
        settled, **{name: "" for name in vars(settled) if name.startswith("prior_")}
    )
    ask = _Questions(calibration, pose_pairs, estimate)
    scaled = PosePairs(
        pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, _scaled(pose_pairs.Ts_cw_c, calibration.scale)
    )
    return Evidence(
        scaled,
        _residuals(calibration, scaled),
        _tracks(calibration, scaled),
        _turning(scaled),
        excitation(scaled),
        ask.growing(settled),
        ask.others(without_prior),
        ask.halves(without_prior),
        _streams(calibration, config, scaled, streams),
        streams or {},
    )


def see_streams(parent, child, max_gap_s):
    """The StreamsSeen of two trajectories on one clock, in one unit of length."""
    start_ns = min(parent.stamps_ns[0], child.stamps_ns[0])
    step_s = max(
        parent.interval_s,
        child.interval_s,
        max(parent.duration_s, child.duration_s) / _MOST_RATES,
    )
    rates, spans = [], []
    for stream in (parent, child):
        found = angular_rates(stream, max(3 * step_s, _SHORTEST_WINDOW_S), step_s, max_gap_s)
        steps = np.arange(len(found.values)) * step_s
        rates.append(((found.start_ns - start_ns) * 1e-9 + steps, found.values))
        gaps = np.flatnonzero(np.diff(stream.stamps_ns) > max_gap_s * 1e9)
        edges = stream.stamps_ns[np.sort(np.r_[0, gaps, gaps + 1, len(stream) - 1])]
        spans.append((edges.reshape(-1, 2) - start_ns) * 1e-9)
    return StreamsSeen(
        tuple(rates), tuple(spans), *_compared_motions(synchronise(parent, child, max_gap_s))
    )


class _Questions:
    """The same question, put to parts of the poses."""

    def __init__(self, calibration, pose_pairs, estimate):
        self._calibration, self._poses, self._estimate = calibration, pose_pairs, estimate

    def growing(self, config):
        """From the first part of the drive, the first two ... to all of it."""
        method = METHODS[config.method]
        ends = np.linspace(0, len(self._poses), method.parts + 1).astype(int)[1:-1]
        return (
            *self._asked(
                [(str(end), slice(0, end), config) for end in ends], method.most_poses_of_many
            ),
            self._result("all"),
        )

    def halves(self, config):
        """From either half alone."""
        half = len(self._poses) // 2
        return self._asked(
            [("first half", slice(0, half), config), ("second half", slice(half, None), config)],
            METHODS[config.method].most_poses_of_few,
        )

    def others(self, config):
        """From other methods and references."""
        stride = _stride(len(self._poses), _MOST_POSES_OF_OTHERS)
        questions = [
            (
                f"{method} B{n * stride}",
                dataclasses.replace(config, method=method, reference=f"B{n}"),
            )
            for method in _COMPARED_METHODS
            for n in _COMPARED_BASELINES
            if n * stride * 4 < len(self._poses)
        ]
        result = f"{self._calibration.method} {self._calibration.reference}"
        asked = [
            (label, slice(None, None, stride), config)
            for label, config in questions
            if label != result
        ]
        label, most = _COMPARED_ESTIMATOR, METHODS[_COMPARED_ESTIMATOR].most_poses_of_few
        if self._calibration.method != label:
            config = dataclasses.replace(config, method=label, reference="auto")
            stride = _stride(len(self._poses), most)
            if stride > 1:
                label = f"{label} (1 in {stride})"
            asked.append((label, slice(None, None, stride), config))
        return tuple(filter(None, (self._answer(*question) for question in asked)))

    def _asked(self, questions, most):
        """Answers to the result's own method, with its reference, from slices of the poses."""
        answers = []
        for label, part, config in questions:
            start, end, _ = part.indices(len(self._poses))
            stride = _stride(end - start, most)
            reference = (
                _coarser(self._calibration.reference, stride)
                if METHODS[config.method].uses_reference
                else "auto"
            )
            config = dataclasses.replace(config, reference=reference)
            answers.append(self._answer(label, slice(start, end, stride), config))
        return tuple(filter(None, answers))

    def _answer(self, label, part, config):
        """An Estimate; None where these poses do not suffice."""
        poses = self._poses[part]
        if len(poses) < _FEWEST_POSES:
            return None
        try:
            calibration = self._estimate(poses, config)
        except HandEyeCalibError:
            return None
        return Estimate(
            label, _seconds(self._poses, poses.stamps_ns[-1]), calibration, part.step or 1
        )

    def _result(self, label):
        return Estimate(label, _seconds(self._poses, self._poses.stamps_ns[-1]), self._calibration)


def _stride(count, most):
    return max(-(-count // most), 1)


def _coarser(reference, stride):
    """The reference that makes about the same pairs of every ``stride``-th pose."""
    if reference[0] not in "BC" or not reference[1:].isdecimal():
        return reference
    return (
        f"{reference[0]}{max(round(int(reference[1:]) / stride), 1 if reference[0] == 'B' else 2)}"
    )


def _seconds(pose_pairs, stamps_ns):
    return (stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9


def _scaled(Ts, scale):
    Ts = Ts.copy()
    Ts[:, :3, 3] *= scale
    return Ts


def _residuals(calibration, pose_pairs):
    residuals = calibration.residuals()
    return Residuals(
        _seconds(pose_pairs, residuals.end_ns),
        residuals.translation_m,
        residuals.rotation_rad,
        ~residuals.is_inlier,
        calibration.reference if METHODS[calibration.method].uses_reference else "B1",
    )


def _tracks(calibration, pose_pairs):
    """Both ways, the worlds brought together by the mean over all poses of where the child's world
    is.
    """
    Ts_cw_p = pose_pairs.Ts_cw_c @ calibration.T_child_parent
    rotations = pose_pairs.Ts_pw_p[:, :3, :3] @ np.swapaxes(Ts_cw_p[:, :3, :3], 1, 2)
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    parent = pose_pairs.Ts_pw_p[:, :3, 3]
    child = Ts_cw_p[:, :3, 3] @ rotation.T
    child = child + np.median(parent - child, axis=0)
    return Tracks(_seconds(pose_pairs, pose_pairs.stamps_ns), parent - parent[0], child - parent[0])


def _streams(calibration, config, pose_pairs, streams):
    if streams:
        child = streams["child"].shifted(calibration.time_offset_s).scaled(calibration.scale)
        return see_streams(streams["parent"], child, config.max_gap)
    parent, child = (
        Trajectory(pose_pairs.stamps_ns, poses)
        for poses in (pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c)
    )
    return see_streams(parent, child, config.max_gap)


def _compared_motions(pose_pairs):
    """Lag, rotation angles and translations along the axes of motions of both sensors, and the
    length of the parent's.
    """
    for lag_s in _LAGS_S:
        start, end = _spans(pose_pairs, lag_s)
        if len(start) >= _FEWEST_MOTIONS:
            break
    chosen = np.unique(
        np.linspace(0, max(len(start) - 1, 0), min(len(start), _MOST_MOTIONS)).astype(int)
    )
    angles, slides, lengths = [], [], []
    for poses in (pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c):
        motions = se3.inverse(poses[start[chosen]]) @ poses[end[chosen]]
        vectors = se3.rotation_log(motions[:, :3, :3])
        angles.append(np.linalg.norm(vectors, axis=1))
        lengths.append(np.linalg.norm(motions[:, :3, 3], axis=1))
        slides.append(
            np.einsum("ki,ki->k", vectors, motions[:, :3, 3]) / np.maximum(angles[-1], 1e-12)
        )
    angles, slides = np.stack(angles, axis=1), np.stack(slides, axis=1)
    moved_m = float(np.sqrt(np.mean(lengths[0] ** 2))) if len(chosen) else 0.0
    return lag_s, angles, slides[(angles > _HAS_AXIS).all(axis=1)], moved_m


def _spans(pose_pairs, span_s):
    """Indices of poses and of those about ``span_s`` later."""
    times_s = _seconds(pose_pairs, pose_pairs.stamps_ns)
    ends = np.searchsorted(times_s, times_s + span_s - 1e-9)
    start = np.flatnonzero(ends < len(times_s))
    return start, np.maximum(ends[start], start + 1)


def _turning(pose_pairs):
    times_s = _seconds(pose_pairs, pose_pairs.stamps_ns)
    start, end = _spans(pose_pairs, _TURNING_S)
    rotation = pose_pairs.Ts_pw_p[:, :3, :3]
    vectors = se3.rotation_log(np.swapaxes(rotation[start], 1, 2) @ rotation[end])
    span_s = float(np.median(times_s[end] - times_s[start])) if len(start) else _TURNING_S
    return Turning(times_s[start], vectors, span_s)
