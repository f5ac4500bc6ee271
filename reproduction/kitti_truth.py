"""Ground truth of the two KITTI drives for what the SLAM systems saw: rectified images.

The published ground truth files hold the calibration of the cameras as they are. The trajectories
come from stereo images that KITTI had rectified, and rectifying turns every camera into a common
orientation. Numbers are from the calibration files that come with the drives.
"""

import numpy as np

from hand_eye_calib.geometry import se3

# calib_cam_to_cam.txt of 2011_10_03: P_rect_02, projection matrix of the left colour camera. Its
# last column is -K times the camera's place in the frame of camera 0, the left grey one.
_P_RECT_02 = np.array(
    [
        [718.856, 0.0, 607.1928, 45.38225],
        [0.0, 718.856, 185.2157, -0.1130887],
        [0.0, 0.0, 1.0, 0.003779761],
    ]
)

# calib_velo_to_cam.txt and R_rect_00 of calib_cam_to_cam.txt of 2011_09_30, put together: rectified
# camera 0 in the lidar's frame.
_T_LIDAR_CAMERA = se3.from_quat_xyzw(
    (0.3335, -0.0048, -0.0756), (-0.499146, 0.504085, -0.496817, 0.499924)
)

RECTIFIED = {
    "kitti_short": _T_LIDAR_CAMERA,
    "kitti_long": se3.from_rotation_translation(
        np.eye(3), -np.linalg.solve(_P_RECT_02[:, :3], _P_RECT_02[:, 3])
    ),
}
