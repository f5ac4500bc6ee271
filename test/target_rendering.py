"""Images of printed targets, as a camera without distortion sees them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.geometry import se3

cv2 = pytest.importorskip("cv2", reason="needs opencv-python-headless")

MATRIX = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 480.0], [0.0, 0.0, 1.0]])
SIZE = (1280, 960)
SUPER = 3
BOARD = (7, 5, 0.05, 0.037)
PIXELS_PER_M = 4000
CAMERA_INFO = """\
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 640, 0, 900, 480, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


def homography_of(T_camera_picture):
    """Homography from pixels of a picture to finer pixels of its image."""
    to_metres = np.diag([1 / PIXELS_PER_M, 1 / PIXELS_PER_M, 1.0])
    to_metres[:2, 2] = 0.5 / PIXELS_PER_M
    half_pixel = (SUPER - 1) / 2
    to_fine = np.array(
        [[SUPER, 0, half_pixel], [0, SUPER, half_pixel], [0, 0, 1.0]]
    )
    to_camera = T_camera_picture[:3, [0, 1, 3]]
    return to_fine @ MATRIX @ to_camera @ to_metres


def rendered(picture, T_camera_picture, rng):
    """A grey image of a flat picture, whose pixels are in metres along x and down along y."""
    homography = homography_of(T_camera_picture)
    height, width = picture.shape
    corners = homography @ [
        [0, width, 0, width],
        [0, 0, height, height],
        [1, 1, 1, 1],
    ]
    pixels = corners[:2] / corners[2] / SUPER
    left, top = np.clip(pixels.min(axis=1) - 2, 0, SIZE).astype(int)
    right, bottom = np.clip(pixels.max(axis=1) + 3, 0, SIZE).astype(int)
    columns = int(right - left)
    rows = int(bottom - top)
    homography[:2] -= SUPER * np.outer([left, top], homography[2])

    look = cv2.INTER_AREA
    size = (SUPER * columns, SUPER * rows)
    fine = cv2.warpPerspective(
        picture, homography, size, flags=look, borderValue=200
    )
    coarse = cv2.resize(fine, (columns, rows), interpolation=look)
    # Grey beside the picture.
    image = np.full(SIZE[::-1], 200, np.uint8)
    image[top:bottom, left:right] = coarse
    noise = rng.normal(0.0, 3.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def charuco_picture():
    columns, rows, square, marker = BOARD
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, dictionary)
    return board.generateImage(
        (
            round(columns * square * PIXELS_PER_M),
            round(rows * square * PIXELS_PER_M),
        )
    )


def aprilgrid_picture(columns, rows, size, gap):
    """As Kalibr prints it: from the lower left tag on, upright, with a border of two bits."""
    dictionary = cv2.aruco.getPredefinedDictionary(
        cv2.aruco.DICT_APRILTAG_36h11
    )
    side = round(size * PIXELS_PER_M)
    step = round((size + gap) * PIXELS_PER_M)
    picture = np.full((rows * step, columns * step), 255, dtype=np.uint8)
    for number in range(columns * rows):
        # OpenCV draws the tags of this family upside down.
        tag = cv2.aruco.generateImageMarker(
            dictionary, number, side, borderBits=2
        )[::-1, ::-1]
        left = number % columns * step
        bottom = picture.shape[0] - number // columns * step
        picture[bottom - side : bottom, left : left + side] = tag
    return picture


def views(count, center, rng):
    """Poses of the picture in the camera, some half a metre before it."""
    rotation_vectors = rng.uniform(-0.5, 0.5, (count, 3))
    turns = Rotation.from_rotvec(rotation_vectors).as_matrix()
    sideways = rng.uniform(-0.08, 0.08, (count, 2))
    depths = rng.uniform(0.5, 0.7, count)
    centers = np.c_[sideways, depths]
    return se3.from_rotation_translation(turns, centers - turns @ center)
