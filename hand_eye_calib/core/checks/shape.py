"""Shape of the motion: evidence for poses or for inverse poses in both streams.

A rigid mount fits poses and inverse poses equally well. But some point of a moving body, such as a
point of the axle, has a short path in the world. If the recorded poses are inverse, they describe
the motion of the world in the sensor's frame, where each point of the world has a long path. The
evidence is the log ratio of two shortest paths: for the recorded poses, and for their inverses.
"""

import numpy as np

from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, medians, robust_weights
from hand_eye_calib.core.checks.stream_pair import LAGS_S, StreamPair
from hand_eye_calib.core.checks.streams import coarse
from hand_eye_calib.core.geometry import se3

# Log ratio of the paths that correct poses may have if the sensors move around a target. Measured:
# 0.4 for a camera.
_TARGET_LOG_RATIO = 0.5

# Reweighted rounds of the search for the point with the shortest path.
_ROUNDS = 5

# Two frames may be the same frame if the angle (rad) between them is smaller than this drift. In 50
# simulated recordings of up to four minutes in one world, the drift was at most 0.03 rad.
_SAME_FRAME_RAD = 0.1
# Shorter lever arms (m) are replaced by this length.
_MIN_ARM_M = 0.01
# Largest absolute evidence of the lever arms. Two worlds may have the same origin by chance, so
# lever arms must not outweigh clear paths. On machines, the log ratio of the paths was at least
# 0.7.
_MAX_OF_ARMS = 0.5

# Reach of a robot arm (m). The path of a hand may be longer than the path of the base in the frame
# of the hand. Correct poses within this reach may therefore look inverse.
_REACH_M = 3.0


def may_be_an_arm(streams: StreamPair) -> bool:
    """Return whether the sensors may be those of a robot arm.

    This is so if the streams consist of single stops, or if both the poses and the inverse poses
    stay within the reach of an arm.
    """
    if streams.is_slow:
        return True
    for poses in (streams.parent.poses, streams.child.poses):
        for candidates in (poses, se3.inverse(poses)):
            positions = se3.translation_of(candidates)
            from_middle = positions - medians(positions.T)
            distances_m = np.linalg.norm(from_middle, axis=1)
            if distances_m.max() >= _REACH_M:
                return False
    return True


def evidence_for_inverse(
    corrected: StreamPair, fit: SimilarityFit
) -> tuple[float, float]:
    """Compute the evidence for inverse poses in both streams.

    The paths of sensors that move around a target look inverse: the shortest path, that of the
    target, is less than half of the sensor's path. The log ratio that a target can cause is then
    subtracted.

    Parameters
    ----------
    corrected : StreamPair
        Streams without other mistakes.
    fit : SimilarityFit
        Fit of these streams.

    Returns
    -------
    float, float
        Log ratio of the paths, and half the log ratio of the lever arms (limited). A ratio is the
        value of the recorded streams divided by the value of the inverse streams. Positive logs
        are evidence for inverse poses.
    """
    log_ratios = []
    for stream in (corrected.parent, corrected.child):
        poses = coarse(stream, LAGS_S[-1]).poses
        # The motion between stops is not recorded, so the changes of velocity are unknown.
        order = 2 if stream.interval_s < LAGS_S[-1] else 1
        shortest, path_of_origin = _shortest_path(poses, order)
        shortest_of_inverse, _ = _shortest_path(se3.inverse(poses), order)
        log_ratios.append(
            np.log([shortest / shortest_of_inverse, shortest / path_of_origin])
        )
    # Mean of both streams.
    paths, relative_to_origin = np.mean(log_ratios, axis=0)
    looks_at_a_point = relative_to_origin < np.log(0.5)
    if looks_at_a_point and paths > 0.0:
        paths = max(paths - _TARGET_LOG_RATIO, 0.0)
    return float(paths), _evidence_of_lever_arms(corrected, fit)


def _evidence_of_lever_arms(corrected: StreamPair, fit: SimilarityFit) -> float:
    """Return half the log ratio of two lever arms: between the sensors, and between the worlds.

    The result is limited to _MAX_OF_ARMS. A short lever arm is no evidence if both streams may have
    the same world (apart from drift) or the same sensor frame; the result is then 0.
    """
    pairs = corrected.synchronised.child_scaled(fit.scale)
    worlds = pairs.Ts_pw_p @ fit.T_parent_child @ se3.inverse(pairs.Ts_cw_c)
    Ts = np.array([fit.T_parent_child, medians(np.moveaxis(worlds, 0, 2))])
    arms_m = np.maximum(
        np.linalg.norm(se3.translation_of(Ts), axis=1), _MIN_ARM_M
    )
    angles_rad = se3.rotation_angle(se3.rotation_of(Ts))
    if angles_rad[np.argmin(arms_m)] <= _SAME_FRAME_RAD:
        return 0.0
    evidence = 0.5 * np.log(arms_m[0] / arms_m[1])
    return float(np.clip(evidence, -_MAX_OF_ARMS, _MAX_OF_ARMS))


def _shortest_path(poses: FloatArray, order: int) -> tuple[float, float]:
    """Return the path lengths (m) of the body's point with the shortest path, and of its origin.

    A point p of the body is at R p + t. Its path is the sum of the lengths of the differences of
    R p + t: first differences for ``order`` 1, second differences for ``order`` 2. Iteratively
    reweighted least squares minimises this sum.
    """
    changes = np.diff(poses[:, :3], order, axis=0)
    steps = changes[:, :, 3]
    chords = changes[:, :, :3]
    # Lengths of the differences in each round. Round 0 has the origin, p = 0.
    lengths = [np.linalg.norm(steps, axis=1) + 1e-9]
    for _ in range(_ROUNDS):
        smallest = 0.01 * median(lengths[-1])
        weights = robust_weights("huber", (lengths[-1] / smallest) ** 2)
        roots = np.sqrt(weights)
        rows = (roots[:, None, None] * chords).reshape(-1, 3)
        targets = (roots[:, None] * steps).ravel()
        minus_p = np.linalg.lstsq(rows, targets, rcond=1e-6)[0]
        remaining = steps - chords @ minus_p
        lengths.append(np.linalg.norm(remaining, axis=1) + 1e-9)
    paths_m = [float(lengths_m.sum()) for lengths_m in lengths]
    return min(paths_m), paths_m[0]
