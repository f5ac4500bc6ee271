"""Errors of odometry and SLAM in a trajectory (Välimäki et al. 2023, section 4.1).

If the article's text and its published trajectories differ, this follows the trajectories: the
value called sigma^2 is a standard deviation, jumps last until the end, drift affects the child
sensor only.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.simulation.options import NoiseConfig

# Variance of a jump per axis, m^2.
JUMP_VARIANCE = 0.02


def add_noise(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, noise: NoiseConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Add Gaussian noise, then drift (child only), then jumps to the trajectories of both sensors.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) and (M, 4, 4) arrays
    noise : NoiseConfig
    rng : numpy.random.Generator
        Each kind of noise draws from a stream of its own: a change of one does not change the
        others.

    Returns
    -------
    Ts_pw_p, Ts_cw_c : arrays of the same shapes
    """
    gaussian, drift, jumps = rng.spawn(3)
    Ts_pw_p, Ts_cw_c = (
        add_gaussian(poses, noise.gaussian, gaussian, noise.rotation_per_metre)
        for poses in (Ts_pw_p, Ts_cw_c)
    )
    Ts_cw_c = add_drift(Ts_cw_c, noise.drift, drift)
    Ts_pw_p, Ts_cw_c = (add_jumps(poses, noise.outliers, jumps) for poses in (Ts_pw_p, Ts_cw_c))
    return Ts_pw_p, Ts_cw_c


def add_gaussian(
    Ts_world_sensor: FloatArray,
    level: float,
    rng: np.random.Generator,
    rotation_per_metre: float = NoiseConfig.rotation_per_metre,
) -> FloatArray:
    """Add an independent error to every pose, in the frame of the sensor.

    Parameters
    ----------
    Ts_world_sensor : (N, 4, 4) array
    level : float
        Standard deviation of each translation component, m.
    rng : numpy.random.Generator
    rotation_per_metre : float
        ZYX Euler angles have standard deviation ``level * rotation_per_metre`` rad.
    """
    angles = level * rotation_per_metre * rng.standard_normal((len(Ts_world_sensor), 3))
    translation = level * rng.standard_normal((len(Ts_world_sensor), 3))
    return Ts_world_sensor @ se3.from_rotation_translation(
        Rotation.from_euler("ZYX", angles).as_matrix(), translation
    )


def add_drift(Ts_world_sensor: FloatArray, rate: float, rng: np.random.Generator) -> FloatArray:
    """Add ``rate`` times the length of each step to it, along one axis of the sensor drawn once.

    Parameters
    ----------
    Ts_world_sensor : (N, 4, 4) array
    rate : float
        m per m.
    rng : numpy.random.Generator
    """
    axis = rng.integers(3)
    lengths = np.linalg.norm(np.diff(Ts_world_sensor[:, :3, 3], axis=0), axis=1)
    drifted = Ts_world_sensor.copy()
    drifted[1:, :3, 3] += np.cumsum(
        rate * lengths[:, None] * Ts_world_sensor[:-1, :3, axis], axis=0
    )
    return drifted


def add_jumps(
    Ts_world_sensor: FloatArray,
    share: float,
    rng: np.random.Generator,
    variance: float = JUMP_VARIANCE,
) -> FloatArray:
    """Shift the rest of the trajectory, along the axes of the world, at a share of the poses.

    Parameters
    ----------
    Ts_world_sensor : (N, 4, 4) array
    share : float
        ``round(share * N)`` poses are drawn, with replacement.
    rng : numpy.random.Generator
    variance : float
        Of the shift per axis, m^2.
    """
    count = len(Ts_world_sensor)
    indices = rng.integers(count, size=round(share * count))
    shifts = np.zeros((count, 3))
    np.add.at(shifts, indices, np.sqrt(variance) * rng.standard_normal((len(indices), 3)))
    jumped = Ts_world_sensor.copy()
    jumped[:, :3, 3] += np.cumsum(shifts, axis=0)
    return jumped
