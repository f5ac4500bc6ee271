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
    rotation_vectors = random.normal(size=(n, 3)) * 0.35
    turns = se3.rotation_exp(rotation_vectors)
    down = se3.rotation_exp(np.array([3.0, 0.05, 0.1]))
    home = np.array([0.45, 0.0, 0.4])
    positions = home + random.normal(size=(n, 3)) * 0.1
    robot = se3.from_rotation_translation(down @ turns, positions)
    sigmas = noise_m * np.repeat([1.0, 2.0], 3)
    noise = se3.exp(random.normal(size=(n, 6)) * sigmas)

    if place == ON_HAND:
        camera = pose((0.06, -0.03, 0.09), (0.1, -0.05, 1.5))
        target = pose((0.5, 0.05, 0.02), (0.0, 0.0, 0.4))
        target_in_camera = se3.inverse(robot @ camera) @ target
    else:
        camera = pose((1.1, 0.2, 0.8), (-1.2, 1.4, -0.6))
        target = pose((0.02, 0.0, 0.1), (0.1, 0.2, 0.3))
        target_in_camera = se3.inverse(camera) @ robot @ target
    return robot, target_in_camera @ noise, camera


def scaled(Ts, factor):
    Ts_scaled = Ts.copy()
    Ts_scaled[:, :3, 3] *= factor
    return Ts_scaled


def scalar_first(Ts):
    """Poses as they are read if quaternions w x y z are taken for x y z w."""
    rows = se3.to_rows(Ts)
    positions = rows[:, :3]
    quats_wxyz = np.roll(rows[:, 3:], 1, axis=1)
    return se3.from_quat_xyzw(positions, quats_wxyz)


def with_rotations(Ts, rotations):
    positions = Ts[:, :3, 3]
    return se3.from_rotation_translation(rotations, positions)


def transposed_rotations(Ts):
    rotations = Ts[:, :3, :3]
    transposed = np.swapaxes(rotations, 1, 2)
    return with_rotations(Ts, transposed)


def angles_as_vectors(Ts):
    angles = se3.rotation_to_rpy(Ts[:, :3, :3])
    rotations = se3.rotation_exp(angles)
    return with_rotations(Ts, rotations)


def flipped(Ts):
    Ts_flipped = Ts.copy()
    Ts_flipped[:, 1, 3] *= -1.0
    return Ts_flipped


def without_middle(Ts):
    middle = len(Ts) // 2
    return np.delete(Ts, middle, axis=0)


def never_moved(Ts):
    count = len(Ts)
    return np.repeat(Ts[:1], count, axis=0)


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
