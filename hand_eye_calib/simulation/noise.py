"""What odometry and SLAM do to a trajectory (Välimäki et al. 2023, section 4.1).

Where the article's text and its published trajectories differ, this follows the trajectories: the
number called sigma^2 is a standard deviation, jumps last until the end, drift affects the child
sensor only.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.geometry import se3
from hand_eye_calib.simulation.options import NoiseConfig

JUMP_VARIANCE = 0.02


def add_noise(Ts_pw_p, Ts_cw_c, noise, rng):
    """Both sensors' trajectories with Gaussian noise, then drift (child only), then jumps.

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) and (M, 4, 4) arrays
    noise : NoiseConfig
    rng : numpy.random.Generator
        Each kind of noise draws from a stream of its own: raising one leaves the others as they
        were.

    Returns
    -------
    Ts_pw_p, Ts_cw_c : arrays like the given ones
    """
    gaussian, drift, jumps = rng.spawn(3)
    Ts_pw_p, Ts_cw_c = (
        add_gaussian(poses, noise.gaussian, gaussian, noise.rotation_per_metre)
        for poses in (Ts_pw_p, Ts_cw_c)
    )
    Ts_cw_c = add_drift(Ts_cw_c, noise.drift, drift)
    Ts_pw_p, Ts_cw_c = (add_jumps(poses, noise.outliers, jumps) for poses in (Ts_pw_p, Ts_cw_c))
    return Ts_pw_p, Ts_cw_c


def add_gaussian(Ts_world_sensor, level, rng, rotation_per_metre=NoiseConfig.rotation_per_metre):
    """Independent errors of every pose, in the sensor's frame.

    Parameters
    ----------
    Ts_world_sensor : (N, 4, 4) array
    level : float
        Standard deviation a of each translation component, m.
    rng : numpy.random.Generator
    rotation_per_metre : float
        ZYX Euler angles have standard deviation ``level * rotation_per_metre`` rad.
    """
    angles = level * rotation_per_metre * rng.standard_normal((len(Ts_world_sensor), 3))
    translation = level * rng.standard_normal((len(Ts_world_sensor), 3))
    return Ts_world_sensor @ se3.from_rotation_translation(
        Rotation.from_euler("ZYX", angles).as_matrix(), translation
    )


def add_drift(Ts_world_sensor, rate, rng):
    """Every step's translation grows by ``rate`` times its length along one axis of the sensor's
    frame, drawn once.

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


def add_jumps(Ts_world_sensor, share, rng, variance=JUMP_VARIANCE):
    """At a share of the poses the rest of the trajectory is shifted, along the world's axes, for
    good.

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
