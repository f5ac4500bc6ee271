"""Shape of the motion: evidence for or against inverse poses in both streams."""

import numpy as np

from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, medians, robust_weights
from hand_eye_calib.core.checks.stream_pair import LAGS_S, StreamPair
from hand_eye_calib.core.checks.streams import coarse
from hand_eye_calib.core.geometry import se3

# Log ratio of the paths of sensors that look at a point: 0.4 for a camera around its target.
_OF_TARGET = 0.5

# Reweighted rounds of the search for the point with the shortest path.
_ROUNDS = 5

# Two frames may be one frame below this distance (m) and this angle (rad). If both streams have
# one world, the lever arm between the worlds is no evidence.
_SAME_FRAME_M = 0.03
_SAME_FRAME_RAD = 0.01
# Shortest lever arm (m) that is compared.
_SHORTEST_ARM_M = 0.01

# Reach of a robot arm (m). The hand of an arm may move more than its base moves in the frame of the
# hand. Poses within this distance may therefore be right although they look inverse.
_REACH_M = 3.0


def may_be_an_arm(streams: StreamPair) -> bool:
    """Return whether the streams are stops, or stay within the reach of an arm."""
    if streams.is_slow:
        return True
    for poses in (streams.parent.poses, streams.child.poses):
        for reading in (poses, se3.inverse(poses)):
            positions = se3.translation_of(reading)
            if np.linalg.norm(positions - medians(positions.T), axis=1).max() >= _REACH_M:
                return False
    return True


def evidence_for_inverse(right: StreamPair, fit: SimilarityFit) -> tuple[float, float]:
    """Return evidence for inverse poses: the log ratio of the paths, and half that of lever arms.

    A ratio compares the streams as they are with both streams inverted. Some point of a body, such
    as an axle, has a short path. If poses are inverse, that point is a point of the world in the
    frame of the body. Sensors that move around a point that they look at have such paths, too: the
    path of that point is less than half of their own.
    """
    logs = []
    for stream in (right.parent, right.child):
        poses = coarse(stream, LAGS_S[-1]).poses
        # Stops contain only places, and not the motion between them.
        order = 2 if stream.interval_s < LAGS_S[-1] else 1
        shortest, path_of_origin = _shortest_path(poses, order)
        shortest_of_inverse, _ = _shortest_path(se3.inverse(poses), order)
        logs.append(np.log([shortest / shortest_of_inverse, shortest / path_of_origin]))
    paths, relative_to_origin = np.mean(logs, axis=0)
    looks_at_a_point = relative_to_origin < np.log(0.5)
    if looks_at_a_point and paths > 0.0:
        paths = max(paths - _OF_TARGET, 0.0)
    return float(paths), _evidence_of_lever_arms(right, fit)


def _evidence_of_lever_arms(right: StreamPair, fit: SimilarityFit) -> float:
    """Return half the log ratio of the lever arms between the sensors and between the worlds.

    The result is 0 if the streams have one frame in common.
    """
    pairs = right.synchronised.child_scaled(fit.scale)
    worlds = pairs.Ts_pw_p @ fit.T_parent_child @ se3.inverse(pairs.Ts_cw_c)
    Ts = np.array([fit.T_parent_child, medians(np.moveaxis(worlds, 0, 2))])
    arms_m = np.maximum(np.linalg.norm(se3.translation_of(Ts), axis=1), _SHORTEST_ARM_M)
    angles_rad = se3.rotation_angle(se3.rotation_of(Ts))
    are_same = (arms_m <= _SAME_FRAME_M) & (angles_rad <= _SAME_FRAME_RAD)
    if are_same.any():
        return 0.0
    return float(0.5 * np.log(arms_m[0] / arms_m[1]))


def _shortest_path(poses: FloatArray, order: int) -> tuple[float, float]:
    """Return the path (m) of the point of a body with the shortest path, and that of its origin.

    For ``order`` 2 the path is the sum of the changes of velocity instead of place.
    """
    changes = np.diff(poses[:, :3], order, axis=0)
    steps = changes[:, :, 3]
    chords = changes[:, :, :3]
    lengths = [np.linalg.norm(steps, axis=1) + 1e-9]
    for _ in range(_ROUNDS):
        smallest = 0.01 * median(lengths[-1])
        roots = np.sqrt(robust_weights("huber", (lengths[-1] / smallest) ** 2))
        rows = (roots[:, None, None] * chords).reshape(-1, 3)
        target = roots[:, None] * steps
        point = np.linalg.lstsq(rows, target.ravel(), rcond=1e-6)[0]
        lengths.append(np.linalg.norm(steps - chords @ point, axis=1) + 1e-9)
    paths_m = [float(lengths_m.sum()) for lengths_m in lengths]
    return min(paths_m), paths_m[0]
