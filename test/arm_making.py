"""Stops of a simulated arm, and mistakes that people make with them."""

import numpy as np

from hand_eye_calib.core.geometry import se3

# Errors of twenty stops; five standard deviations.
WITHIN_M = 0.006
WITHIN_RAD = 0.005

ON_HAND = "on the hand"
BESIDE = "beside the robot"


def pose(position, rotation_vector):
    rotation = se3.rotation_exp(np.array(rotation_vector))
    return se3.from_rotation_translation(rotation, np.array(position))


def arm(place, seed=0, n=20, noise_m=0.0005):
    """Poses of the hand in the base, of the target in the camera, and where the camera is."""
    random = np.random.default_rng(seed)
    turns = se3.rotation_exp(random.normal(size=(n, 3)) * 0.35)
    down = se3.rotation_exp(np.array([3.0, 0.05, 0.1]))
    positions = np.array([0.45, 0.0, 0.4]) + random.normal(size=(n, 3)) * 0.1
    robot = se3.from_rotation_translation(down @ turns, positions)
    noise = se3.exp(random.normal(size=(n, 6)) * noise_m * np.repeat([1.0, 2.0], 3))
    if place == ON_HAND:
        camera = pose((0.06, -0.03, 0.09), (0.1, -0.05, 1.5))
        target = pose((0.5, 0.05, 0.02), (0.0, 0.0, 0.4))
        return robot, se3.inverse(robot @ camera) @ target @ noise, camera
    camera = pose((1.1, 0.2, 0.8), (-1.2, 1.4, -0.6))
    target = pose((0.02, 0.0, 0.1), (0.1, 0.2, 0.3))
    return robot, se3.inverse(camera) @ robot @ target @ noise, camera


def scaled(Ts, factor):
    return se3.from_rotation_translation(Ts[:, :3, :3], factor * Ts[:, :3, 3])


def scalar_first(Ts):
    """Poses as they are read if quaternions w x y z are taken for x y z w."""
    rows = se3.to_rows(Ts)
    return se3.from_quat_xyzw(rows[:, :3], np.roll(rows[:, 3:], 1, axis=1))


def with_rotations(Ts, rotations):
    return se3.from_rotation_translation(rotations, Ts[:, :3, 3])


def transposed_rotations(Ts):
    return with_rotations(Ts, np.swapaxes(Ts[:, :3, :3], 1, 2))


def angles_as_vectors(Ts):
    return with_rotations(Ts, se3.rotation_exp(se3.rotation_to_rpy(Ts[:, :3, :3])))


def flipped(Ts):
    return se3.from_rotation_translation(Ts[:, :3, :3], Ts[:, :3, 3] * [1.0, -1.0, 1.0])


def without_middle(Ts):
    return np.delete(Ts, len(Ts) // 2, axis=0)


def never_moved(Ts):
    return np.repeat(Ts[:1], len(Ts), axis=0)


def stale(Ts):
    Ts = Ts.copy()
    Ts[5::5] = Ts[4:-1:5]
    return Ts


def same(Ts):
    return Ts


def with_outliers(Ts, count):
    """Poses of which the first ones are wrong by 20 cm and 17 deg on each axis."""
    random = np.random.default_rng(1)
    errors = random.normal(size=(count, 6)) * np.repeat([0.2, 0.3], 3)
    Ts = Ts.copy()
    Ts[:count] = Ts[:count] @ se3.exp(errors)
    return Ts
