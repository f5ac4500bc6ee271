"""Calibrate from arrays, as a SLAM program has them: stamps in seconds, positions, quaternions.

python examples/from_arrays.py
"""

import numpy as np
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec

T_LIDAR_CAMERA = np.eye(4)
T_LIDAR_CAMERA[:3, :3] = Rotation.from_euler(
    "xyz", [-90, 0, -90], degrees=True
).as_matrix()
T_LIDAR_CAMERA[:3, 3] = [0.4, 0.0, -0.1]


def poses_of_a_lidar(times_s: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) on a winding path over hills."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    angles = np.stack(
        [0.1 * np.sin(times_s), 0.1 * np.cos(1.3 * times_s), 0.5 * times_s],
        axis=1,
    )
    poses[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    poses[:, :3, 3] = np.stack(
        [4 * np.sin(0.5 * times_s), 4 * np.cos(0.5 * times_s), 0 * times_s], 1
    )
    return poses


def main() -> hec.Calibration:
    """Calibrate two arrays, one of them of matrices, one of rows as in a TUM file."""
    stamps_s = 1_700_000_000 + np.arange(0, 60, 0.1)
    lidar = poses_of_a_lidar(stamps_s - stamps_s[0])
    camera = lidar @ T_LIDAR_CAMERA
    quats_xyzw = Rotation.from_matrix(camera[:, :3, :3]).as_quat()
    rows = np.column_stack([stamps_s, camera[:, :3, 3], quats_xyzw])

    parent = hec.read_trajectory(lidar, times=stamps_s)
    child = hec.read_trajectory(rows)
    result = hec.calibrate(parent, child)
    print(result)
    return result


if __name__ == "__main__":
    main()
