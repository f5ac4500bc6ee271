"""Poses of a camera from images of a target: a ChArUco board, or an AprilGrid as of Kalibr."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    MissingDependencyError,
    installing,
    required,
)
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.files import read_bytes
from hand_eye_calib.formats.yaml_files import read_yaml

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
# Largest image that is decoded: twice that of the largest camera sensors in industry, 65 million.
_MOST_PIXELS = 130_000_000
# How OpenCV turns images of ROS into grey ones; its names of Bayer patterns begin with another row.
_TO_GREY = {
    **dict.fromkeys(("mono8", "8UC1"), ""),
    **dict.fromkeys(("bgr8", "8UC3"), "BGR2GRAY"),
    **{"rgb8": "RGB2GRAY", "bgra8": "BGRA2GRAY", "rgba8": "RGBA2GRAY"},
    **{"bayer_rggb8": "BayerBG2GRAY", "bayer_bggr8": "BayerRG2GRAY"},
    **{"bayer_gbrg8": "BayerGR2GRAY", "bayer_grbg8": "BayerGB2GRAY"},
    **{"yuv422": "YUV2GRAY_UYVY", "yuv422_yuy2": "YUV2GRAY_YUY2"},
}

# An image needs so many corners of the target, and may miss them by so much (pixels, rms).
_FEWEST_CORNERS = 8
_LARGEST_RMS_PX = 5.0

_EXPECTED_TARGET = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], such as charuco:5x7:0.04:0.03:4X4_50, or "
    "aprilgrid:COLUMNSxROWS:TAG:GAP, such as aprilgrid:6x6:0.088:0.0264; lengths in metres"
)
_EXPECTED_CAMERA = (
    "the intrinsics of a camera: camera_info of ROS, camchain of Kalibr, or camera_matrix and "
    "distortion_coefficients of OpenCV"
)
# Whether a model of distortion is that of a fisheye.
_IS_FISHEYE = dict.fromkeys(("", "none", "plumb_bob", "radtan", "rational_polynomial"), False)
_IS_FISHEYE |= {"equidistant": True, "fisheye": True}


@dataclass(frozen=True)
class Target:
    """A flat target of kind "charuco" or "aprilgrid": its columns and rows of squares or tags; the
    sides (m) of a square and its marker, or of a tag and the gap between two; and OpenCV's name of
    the markers without ``DICT_``.
    """

    kind: str
    columns: int
    rows: int
    size: float
    marker: float
    dictionary: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``charuco:5x7:0.04:0.03:4X4_50`` or ``aprilgrid:6x6:0.088:0.0264``; a ConfigError
        if it is no target.
        """
        kind, *parts = text.split(":")
        names = {"charuco": (*parts[3:], "4X4_50"), "aprilgrid": ("APRILTAG_36h11", *parts[3:])}
        try:
            columns, rows = map(int, parts[0].split("x"))
            size, marker = map(float, parts[1:3])
            is_right = min(columns, rows) > 1 and marker > 0 and 0 < size < 100 and len(parts) <= 4
            if is_right and (kind == "aprilgrid" or marker < size):
                return cls(kind, columns, rows, size, marker, names[kind][0])
        except (IndexError, KeyError, ValueError):
            pass
        raise ConfigError(f"expected a target: {_EXPECTED_TARGET}; got {text!r}")


@dataclass(frozen=True)
class Camera:
    """Intrinsics: matrix (3, 3) in pixels, and distortion by OpenCV's models, or of a fisheye."""

    matrix: FloatArray
    distortion: FloatArray
    is_fisheye: bool

    @classmethod
    def of(cls, where: object, matrix: Any, distortion: Any, model: str = "") -> Self:
        """From 9 numbers, coefficients and the name of their model; an InputError if they are not
        those of a camera.
        """
        try:
            numbers = np.array(matrix, dtype=float).reshape(3, 3)
            if not np.isfinite(numbers).all() or numbers[0, 0] <= 0.0:
                raise ValueError("no focal length")
            return cls(numbers, np.array(distortion, dtype=float).ravel(), _IS_FISHEYE[model])
        except (KeyError, TypeError, ValueError):
            expected = f"{_EXPECTED_CAMERA}; models are {', '.join(filter(None, _IS_FISHEYE))}"
            raise InputError(f"{where}: expected {expected}") from None


def read_camera(path: str | Path) -> Camera:
    """Read intrinsics from YAML of ROS, Kalibr or OpenCV; an InputError if there are none."""
    document: Any = read_yaml(path, _EXPECTED_CAMERA)
    try:
        document = document.get("cam0", document)
        if "intrinsics" in document:
            fu, fv, pu, pv = document["intrinsics"]
            matrix = [fu, 0, pu, 0, fv, pv, 0, 0, 1]
            distortion = document["distortion_coeffs"]
        else:
            matrix, distortion = (
                value["data"] if isinstance(value, Mapping) else value
                for value in (document["camera_matrix"], document["distortion_coefficients"])
            )
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: expected {_EXPECTED_CAMERA}") from None
    return Camera.of(path, matrix, distortion, document.get("distortion_model", ""))


def camera_of(info: Any, is_rectified: bool, where: str) -> Camera:
    """Intrinsics of a CameraInfo message of ROS; of rectified images the projection counts."""
    k, d, p = (info.K, info.D, info.P) if hasattr(info, "K") else (info.k, info.d, info.p)
    if is_rectified:
        return Camera.of(where, np.reshape(p, (3, 4))[:, :3], [])
    return Camera.of(where, k, d, info.distortion_model)


def images_in(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of their names, numbers by their value."""
    images = [path for path in folder.iterdir() if path.suffix.lower() in _IMAGE_SUFFIXES]
    return sorted(images, key=lambda path: _by_number(path.name))


def _by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names with numbers by the value of these."""
    parts = re.split("([0-9]+)", name)
    return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts]


def read_image(path: Path) -> Any:
    """Read an image file in grey.

    Raises
    ------
    InputError
        If it is no regular file, no image, or one of too many pixels.
    """
    return image_in(read_bytes(path), path)


def image_in(data: Any, where: object) -> Any:
    """Return the image in the bytes of an image file, in grey; ``where`` is for messages."""
    cv2 = _opencv()
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        raise InputError(f"{where} has more than {_MOST_PIXELS:,} pixels, or is damaged") from None
    if image is None:
        raise InputError(f"{where} is not an image that can be read")
    return image


def grey_of(message: Any) -> Any:
    """The image of a sensor_msgs/Image or CompressedImage in grey; an InputError if it has none."""
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        return image_in(data, "a compressed image")
    if message.encoding not in _TO_GREY:
        known = ", ".join(_TO_GREY)
        raise InputError(f"images are encoded as {message.encoding[:40]!r}; expected {known}")
    n_channels = message.step // message.width
    conversion = _TO_GREY[message.encoding]
    rows = data.reshape(message.height, message.step)[:, : message.width * n_channels]
    image = rows.reshape(message.height, message.width, n_channels)
    if not conversion:
        return image[:, :, 0]
    return _opencv().cvtColor(image, getattr(_opencv(), f"COLOR_{conversion}"))


@dataclass(frozen=True)
class TargetPoses:
    """Poses (N, 4, 4) of the target in the camera, of the images in which it is seen; the indices
    (N,) of these, by how many pixels (rms) their corners are missed, and standard deviations
    (m, rad) of the poses if the corners err by as much; and the number of all images.
    """

    Ts_camera_target: FloatArray
    images: list[int]
    rms_px: FloatArray
    sigmas: FloatArray
    n_images: int

    def __str__(self) -> str:
        rms_px = np.median(self.rms_px)
        shift_m, turn_rad = np.median(self.sigmas, axis=0)
        return (
            f"the target is seen in {len(self.images)} of {self.n_images} images, its corners to "
            f"{rms_px:.2f} pixels (rms): {length(shift_m)} and {angle(turn_rad)} of a pose"
        )


class TargetFinder:
    """Finds a target in grey images of a camera, and its poses from its corners; a ConfigError for
    markers that OpenCV does not have.
    """

    def __init__(self, target: Target, camera: Camera) -> None:
        self._cv2 = _opencv()
        self._target = target
        self._camera = camera
        aruco = self._cv2.aruco
        self._n_images = 0
        self._found: list[tuple[FloatArray, int, float, FloatArray]] = []
        markers = getattr(aruco, f"DICT_{target.dictionary}", None)
        if markers is None:
            raise ConfigError(
                f"OpenCV has no markers {target.dictionary!r}; expected such as 4X4_50, 5X5_100"
            )
        dictionary = aruco.getPredefinedDictionary(markers)
        size = (target.columns, target.rows)
        # The corners (k, 3) of each number that is detected.
        if target.kind == "charuco":
            board = aruco.CharucoBoard(size, target.size, target.marker, dictionary)
            self._detect = aruco.CharucoDetector(board).detectBoard
            self._corners = np.asarray(board.getChessboardCorners(), dtype=float)[:, None]
            return
        parameters = aruco.DetectorParameters()
        parameters.markerBorderBits = 2  # Kalibr's tags have a border of two bits
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._detect = aruco.ArucoDetector(dictionary, parameters).detectMarkers
        # From the lower left tag on, rows upward. OpenCV has the tags of this family upside down:
        # their corners come from the lower right one on, clockwise.
        square = target.size * np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]])
        y, x = np.divmod(np.arange(target.columns * target.rows), target.columns)
        places = (target.size + target.marker) * np.stack([x, y, 0 * x], axis=-1)
        self._corners = places[:, None] + square

    def look(self, image: Any) -> bool:
        """Whether the next image shows the target, well enough."""
        number = self._n_images
        self._n_images = self._n_images + 1
        pixels, ids, *_ = self._detect(image)
        known = np.ravel([] if ids is None else ids).astype(int)
        is_known = known < len(self._corners)
        corners = self._corners[known[is_known]].reshape(-1, 3)
        if len(corners) < _FEWEST_CORNERS:
            return False
        pixels = np.asarray(pixels, dtype=float).reshape(len(known), -1, 2)[is_known]
        T_camera_target, rms_px, sigmas = self._pose(corners, pixels.reshape(-1, 1, 2))
        if rms_px <= _LARGEST_RMS_PX:
            self._found.append((T_camera_target, number, rms_px, sigmas))
        return rms_px <= _LARGEST_RMS_PX

    def found(self) -> TargetPoses:
        """All poses; an InputError if no image shows the target."""
        if not self._found:
            target = self._target
            raise InputError(
                f"none of {self._n_images} images shows at least {_FEWEST_CORNERS} corners of the "
                f"target {target.kind} {target.columns}x{target.rows} of {target.dictionary}"
            )
        poses, numbers, rms, sigmas = zip(*self._found, strict=True)
        columns = np.stack(poses), list(numbers), np.array(rms), np.array(sigmas)
        return TargetPoses(*columns, self._n_images)

    def _pose(
        self, corners: FloatArray, pixels: FloatArray
    ) -> tuple[FloatArray, float, FloatArray]:
        """Pose of the target in the camera, the rms error of its corners in pixels, and standard
        deviations. Of the two poses that a flat target nearly fits, the better one.
        """
        cv2 = self._cv2
        camera = self._camera
        undistort = cv2.fisheye.undistortPoints if camera.is_fisheye else cv2.undistortPoints
        rays = undistort(pixels, camera.matrix, camera.distortion).reshape(-1, 2)
        ideal = (np.eye(3), None)
        focal = camera.matrix[[0, 1], [0, 1]]
        _, turns, shifts, _ = cv2.solvePnPGeneric(corners, rays, *ideal, flags=cv2.SOLVEPNP_IPPE)
        found = []
        for start in zip(turns, shifts, strict=True):
            turn, shift = cv2.solvePnPRefineLM(corners, rays, *ideal, *start)
            seen, jacobian = cv2.projectPoints(corners, turn, shift, *ideal)
            off = (seen.reshape(-1, 2) - rays) * focal
            rms_px = float(np.sqrt((off**2).sum(axis=1).mean()))
            found.append((rms_px, turn, shift, jacobian[:, :6]))
        rms_px, turn, shift, jacobian = min(found, key=lambda each: each[0])
        of_pixels = jacobian * np.tile(focal, len(corners))[:, None]
        # Two coordinates of a corner share its error; first come rotations, then translations.
        variances = rms_px**2 / 2 * np.diag(np.linalg.pinv(of_pixels.T @ of_pixels))
        sigmas = np.sqrt(variances.reshape(2, 3).mean(axis=1))[::-1]
        T = se3.from_rotation_translation(cv2.Rodrigues(turn)[0], shift.ravel())
        return T, rms_px, sigmas


def _opencv() -> Any:
    # A file of 1 MB may unpack to more memory than there is. OpenCV reads this when it is imported.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MOST_PIXELS))
    cv2 = required("cv2", "finding a target in images", "camera")
    if not hasattr(cv2.aruco, "CharucoDetector"):
        raise MissingDependencyError(
            f"poses from images of a target need OpenCV 4.7 or newer: {installing('camera')}"
        )
    return cv2
