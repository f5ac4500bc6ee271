"""Estimate poses of a camera from images of a flat target.

Targets are ChArUco boards, AprilGrids of Kalibr, chessboards, and single markers (ArUco, AprilTag).
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, Self

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
from hand_eye_calib.extras.sensors.cameras import Camera, read_camera
from hand_eye_calib.formats.files import read_bytes

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
# Most pixels of an image that is decoded. The largest industrial sensors have 65 million.
_MOST_PIXELS = 130_000_000
# OpenCV's conversion from each encoding of ROS to grey. OpenCV names a Bayer pattern by its second
# row, ROS by its first.
_TO_GREY = {
    "mono8": "",
    "8UC1": "",
    "bgr8": "BGR2GRAY",
    "8UC3": "BGR2GRAY",
    "rgb8": "RGB2GRAY",
    "bgra8": "BGRA2GRAY",
    "rgba8": "RGBA2GRAY",
    "bayer_rggb8": "BayerBG2GRAY",
    "bayer_bggr8": "BayerRG2GRAY",
    "bayer_gbrg8": "BayerGR2GRAY",
    "bayer_grbg8": "BayerGB2GRAY",
    "yuv422": "YUV2GRAY_UYVY",
    "yuv422_yuy2": "YUV2GRAY_YUY2",
}

# OpenCV's name of the markers if the text of a target does not contain it.
_DICTIONARY = "4X4_50"
# Fewest inner corners along a side of a chessboard, as OpenCV requires.
_FEWEST_ALONG_SIDE = 3
# Largest side of a square or tag (m). A longer side is in another unit.
_LARGEST_SIZE_M = 100.0
# An image with fewer corners of the target is skipped.
_FEWEST_CORNERS = 8
# Corners of a single marker. All are required.
_CORNERS_OF_MARKER = 4
# An image with larger residuals of its corners (root mean square, pixels) is skipped.
_LARGEST_RMS_PX = 5.0

_EXPECTED_TARGET = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], such as charuco:5x7:0.04:0.03:4X4_50 "
    "(charuco-old: boards made before OpenCV 4.6), aprilgrid:COLUMNSxROWS:TAG:GAP, such as "
    "aprilgrid:6x6:0.088:0.0264, chessboard:COLUMNSxROWS:SQUARE (inner corners), such as "
    "chessboard:8x5:0.03, or marker:NUMBER:SIDE[:DICTIONARY], such as "
    "marker:26:0.1:APRILTAG_36h11; lengths in metres"
)


@dataclass(frozen=True)
class Target:
    """A flat target.

    Attributes
    ----------
    kind : {"charuco", "charuco-old", "aprilgrid", "chessboard", "marker"}
        ``charuco-old`` is the layout of OpenCV before 4.6: the upper left square contains a marker
        if the number of rows is even.
    columns, rows : int
        Numbers of squares or tags. Numbers of inner corners of a chessboard. 1 for a single marker.
    size : float
        Side of a square, tag or single marker, m.
    marker : float
        Side of the marker in a square, or gap between two tags, m. 0 for other targets.
    dictionary : str
        OpenCV's name of the markers without ``DICT_``. Empty for a chessboard.
    number : int
        Number of a single marker in its dictionary. 0 for other targets.
    """

    kind: str
    columns: int
    rows: int
    size: float
    marker: float
    dictionary: str
    number: int = 0

    def __str__(self) -> str:
        if self.kind == "marker":
            return f"marker {self.number} of {self.dictionary}"
        markers = f" of {self.dictionary}" if self.dictionary else ""
        return f"{self.kind} {self.columns}x{self.rows}{markers}"

    @property
    def fewest_corners(self) -> int:
        """Smallest number of corners in an image that is used."""
        return _CORNERS_OF_MARKER if self.kind == "marker" else _FEWEST_CORNERS

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a target, such as ``charuco:5x7:0.04:0.03:4X4_50``.

        Raises
        ------
        ConfigError
            If the text is no target, or a chessboard looks the same after half a turn.
        """
        kind, *parts = text.split(":")
        try:
            if kind == "marker":
                target = cls._marker(parts)
            elif kind == "chessboard":
                target = cls._chessboard(parts)
            else:
                target = cls._grid(kind, parts)
        except (IndexError, ValueError):
            raise _no_target(text) from None
        # The poses of such a chessboard are ambiguous.
        if kind == "chessboard" and (target.columns + target.rows) % 2 == 0:
            raise ConfigError(
                f"a chessboard of {target.columns}x{target.rows} inner corners looks the same "
                "after half a turn; use a board with an even and an odd number, or charuco"
            )
        return target

    @classmethod
    def _grid(cls, kind: str, parts: Sequence[str]) -> Self:
        """Return a ChArUco board or an AprilGrid; raise ValueError if it has wrong numbers."""
        columns, rows = map(int, parts[0].split("x"))
        size, marker = map(float, parts[1:3])
        are_lengths = marker > 0.0 and 0.0 < size < _LARGEST_SIZE_M
        # The tags of an AprilGrid have one dictionary, which is not named.
        most_parts = 3 if kind == "aprilgrid" else 4
        if min(columns, rows) < 2 or not are_lengths or len(parts) > most_parts:
            raise ValueError("no grid")
        if kind == "aprilgrid":
            return cls(kind, columns, rows, size, marker, "APRILTAG_36h11")
        if kind not in ("charuco", "charuco-old") or marker >= size:
            raise ValueError("no ChArUco board")
        dictionary = parts[3] if len(parts) > 3 else _DICTIONARY
        return cls(kind, columns, rows, size, marker, dictionary)

    @classmethod
    def _marker(cls, parts: Sequence[str]) -> Self:
        """Return a single marker; raise ValueError if it has wrong numbers."""
        number = int(parts[0])
        size = float(parts[1])
        if number < 0 or not 0.0 < size < _LARGEST_SIZE_M or len(parts) > 3:
            raise ValueError("no marker")
        dictionary = parts[2] if len(parts) > 2 else _DICTIONARY
        return cls("marker", 1, 1, size, 0.0, dictionary, number)

    @classmethod
    def _chessboard(cls, parts: Sequence[str]) -> Self:
        """Return a chessboard; raise ValueError if it has wrong numbers."""
        columns, rows = map(int, parts[0].split("x"))
        size = float(parts[1])
        is_length = 0.0 < size < _LARGEST_SIZE_M
        if (
            min(columns, rows) < _FEWEST_ALONG_SIDE
            or not is_length
            or len(parts) > 2
        ):
            raise ValueError("no chessboard")
        return cls("chessboard", columns, rows, size, 0.0, "")


def _no_target(text: str) -> ConfigError:
    return ConfigError(f"expected a target: {_EXPECTED_TARGET}; got {text!r}")


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder by name; numbers in names sort by value."""
    images = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in IMAGE_SUFFIXES
    ]
    return sorted(images, key=lambda path: _by_number(path.name))


def _by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names by the values of their numbers."""
    parts = re.split("([0-9]+)", name)
    return [
        (int(part), "") if part.isascii() and part.isdigit() else (-1, part)
        for part in parts
    ]


def read_image(path: Path) -> Any:
    """Read an image file in grey.

    Raises
    ------
    InputError
        If the path is no regular file or no image, or the image has too many pixels.
    """
    return image_in(read_bytes(path), path)


def image_in(data: Any, where: object) -> Any:
    """Decode an image file in grey; ``where`` names the file in errors."""
    cv2 = _opencv()
    try:
        image = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE
        )
    except cv2.error:
        raise InputError(
            f"{where} has more than {_MOST_PIXELS:,} pixels, or is damaged"
        ) from None
    if image is None:
        raise InputError(f"{where} is not a readable image")
    return image


def grey_of(message: Any) -> Any:
    """Return the image of a sensor_msgs/Image or CompressedImage in grey.

    Raises
    ------
    InputError
        If the image cannot be decoded.
    """
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        return image_in(data, "a compressed image")
    conversion = _TO_GREY.get(message.encoding)
    if conversion is None:
        expected = ", ".join(_TO_GREY)
        raise InputError(
            f"images are encoded as {message.encoding[:40]!r}; expected {expected}"
        )
    n_channels = message.step // message.width
    padded_rows = data.reshape(message.height, message.step)
    rows = padded_rows[:, : message.width * n_channels]
    image = rows.reshape(message.height, message.width, n_channels)
    if not conversion:
        return image[:, :, 0]
    cv2 = _opencv()
    return cv2.cvtColor(image, getattr(cv2, f"COLOR_{conversion}"))


@dataclass(frozen=True)
class TargetPoses:
    """Poses of a target in N of all images.

    Attributes
    ----------
    Ts_camera_target : (N, 4, 4) array
    images : list of int
        Indices of the N images.
    rms_px : (N,) array
        Residuals of the corners of each image (root mean square, pixels).
    sigmas : (N, 2) array
        Standard deviations (m, rad) of each pose, from the residuals of its corners.
    corners : list of N (n, 3) arrays
        Places of the detected corners in the frame of the target, m.
    pixels : list of N (n, 2) arrays
        Pixels of these corners.
    n_images : int
        Number of all images.
    """

    Ts_camera_target: FloatArray
    images: list[int]
    rms_px: FloatArray
    sigmas: FloatArray
    corners: list[FloatArray]
    pixels: list[FloatArray]
    n_images: int

    def __str__(self) -> str:
        rms_px = np.median(self.rms_px)
        shift_m, turn_rad = np.median(self.sigmas, axis=0)
        return (
            f"the target is visible in {len(self.images)} of {self.n_images} "
            f"images, with corner residuals of {rms_px:.2f} pixels (rms): "
            f"{length(shift_m)} and {angle(turn_rad)} of a pose"
        )


class _Pose(NamedTuple):
    """Pose of the target in an image.

    Attributes
    ----------
    T_camera_target : (4, 4) array
    rms_px : float
        Residual of the corners (root mean square, pixels).
    sigmas : (2,) array
        Standard deviations of the pose (m, rad).
    corners : (n, 3) array
        Places of the detected corners in the frame of the target, m.
    pixels : (n, 2) array
        Pixels of these corners.
    """

    T_camera_target: FloatArray
    rms_px: float
    sigmas: FloatArray
    corners: FloatArray
    pixels: FloatArray


class _Detector(NamedTuple):
    """Detection of the corners of a target.

    Attributes
    ----------
    detect : callable
        ``detect(image)`` returns pixels of corners, and numbers of markers or corners. Both are
        None if there are no corners in the grey image.
    corners : (n, k, 3) array
        Places of the corners, m, by the number of their marker or corner. The first row belongs to
        ``Target.number``. k is 4 for tags and markers, and 1 for inner corners of boards.
    """

    detect: Callable[[Any], Any]
    corners: FloatArray


class TargetFinder:
    """Detect a target in grey images of a camera, and estimate its poses from its corners.

    Attributes
    ----------
    camera : Camera

    Raises
    ------
    ConfigError
        If OpenCV does not have the markers of the target.
    MissingDependencyError
        If OpenCV is not installed, or too old for the target.
    """

    def __init__(self, target: Target, camera: Camera) -> None:
        self._cv2 = _opencv()
        self._target = target
        self.camera = camera
        self._n_images = 0
        # Poses by the index of the image.
        self._poses: dict[int, _Pose] = {}
        self._detect, self._corners = _detector(self._cv2, target)

    @classmethod
    def parse(cls, target: str, camera: str | Path) -> Self:
        """Return the finder of a target in words, with the intrinsics of a file.

        Raises
        ------
        ConfigError, InputError, MissingDependencyError
            If the text names no target, the file has no intrinsics, or OpenCV is not installed.
        """
        return cls(Target.parse(target), read_camera(camera))

    def look(self, image: Any) -> bool:
        """Detect the target in the next image; return whether a pose was estimated."""
        number = self._n_images
        self._n_images += 1
        pixels, detected, *_ = self._detect(image)
        ids = np.ravel([] if detected is None else detected).astype(int)
        indices = ids - self._target.number
        is_on_target = (indices >= 0) & (indices < len(self._corners))
        corners = self._corners[indices[is_on_target]].reshape(-1, 3)
        if len(corners) < self._target.fewest_corners:
            return False
        pixels = np.asarray(pixels, dtype=float).reshape(len(ids), -1, 2)
        pixels = pixels[is_on_target]
        pose = self._pose(corners, pixels.reshape(-1, 1, 2))
        is_good = pose.rms_px <= _LARGEST_RMS_PX
        if is_good:
            self._poses[number] = pose
        return is_good

    def found(self) -> TargetPoses:
        """Return all poses.

        Raises
        ------
        InputError
            If no image contains the target.
        """
        if not self._poses:
            raise InputError(
                f"none of {self._n_images} images contains at least "
                f"{self._target.fewest_corners} corners of the target {self._target}"
            )
        poses = [*self._poses.values()]
        return TargetPoses(
            Ts_camera_target=np.array([pose.T_camera_target for pose in poses]),
            images=[*self._poses],
            rms_px=np.array([pose.rms_px for pose in poses]),
            sigmas=np.array([pose.sigmas for pose in poses]),
            corners=[pose.corners for pose in poses],
            pixels=[pose.pixels for pose in poses],
            n_images=self._n_images,
        )

    def _pose(self, corners: FloatArray, pixels: FloatArray) -> _Pose:
        """Estimate the pose of the target from its corners (n, 3) at pixels (n, 1, 2).

        Two poses nearly fit a flat target. The one with the smaller residual is returned.
        """
        cv2 = self._cv2
        camera = self.camera
        undistort = (
            cv2.fisheye.undistortPoints
            if camera.is_fisheye
            else cv2.undistortPoints
        )
        rays = undistort(pixels, camera.matrix, camera.distortion).reshape(
            -1, 2
        )
        focal = camera.matrix[[0, 1], [0, 1]]
        # Rays are pixels of a camera without distortion, with this matrix.
        ideal = (np.eye(3), None)
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            corners, rays, *ideal, flags=cv2.SOLVEPNP_IPPE
        )
        candidates = []
        for start in zip(rotations, translations, strict=True):
            vector, shift = cv2.solvePnPRefineLM(corners, rays, *ideal, *start)
            projected, derivatives = cv2.projectPoints(
                corners, vector, shift, *ideal
            )
            residuals = (projected.reshape(-1, 2) - rays) * focal
            rms_px = float(np.sqrt((residuals**2).sum(axis=1).mean()))
            candidates.append((rms_px, vector, shift, derivatives[:, :6]))
        rms_px, vector, shift, derivatives = min(candidates, key=itemgetter(0))
        T = se3.from_rotation_translation(
            cv2.Rodrigues(vector)[0], shift.ravel()
        )
        jacobian = derivatives * np.tile(focal, len(corners))[:, None]
        # Each corner has two residuals. The pose has six degrees of freedom.
        degrees_of_freedom = 2 * len(corners) - 6
        variance_px2 = len(corners) * rms_px**2 / degrees_of_freedom
        unit_covariance = np.linalg.pinv(jacobian.T @ jacobian)
        variances = variance_px2 * np.diag(unit_covariance)
        # OpenCV's parameters are rotations, then translations.
        turn_rad, shift_m = np.sqrt(variances.reshape(2, 3).mean(axis=1))
        sigmas = np.array([shift_m, turn_rad])
        return _Pose(T, rms_px, sigmas, corners, pixels.reshape(-1, 2))


def _detector(cv2: Any, target: Target) -> _Detector:
    """Return the detector of a target.

    Raises
    ------
    ConfigError
        If OpenCV does not have the markers of the target.
    MissingDependencyError
        If OpenCV is too old for the target.
    """
    if target.kind == "chessboard":
        return _Detector(
            partial(_detect_chessboard, cv2, target),
            _chessboard_corners(target),
        )
    dictionary = _dictionary(cv2, target)
    if target.kind == "aprilgrid":
        # Kalibr's tags have a border of two bits.
        return _tag_detector(cv2, dictionary, 2, _aprilgrid_corners(target))
    if target.kind == "marker":
        return _tag_detector(cv2, dictionary, 1, _marker_corners(target))
    size = (target.columns, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.size, target.marker, dictionary)
    if target.kind == "charuco-old":
        if not hasattr(board, "setLegacyPattern"):
            raise MissingDependencyError(
                f"targets charuco-old need OpenCV 4.8 or newer: {installing('camera')}"
            )
        board.setLegacyPattern(True)
    corners = np.asarray(board.getChessboardCorners(), dtype=float)[:, None]
    return _Detector(cv2.aruco.CharucoDetector(board).detectBoard, corners)


def _dictionary(cv2: Any, target: Target) -> Any:
    """Return OpenCV's dictionary of the markers; raise ConfigError if it has not all of them."""
    markers = getattr(cv2.aruco, f"DICT_{target.dictionary}", None)
    if markers is None:
        raise ConfigError(
            f"OpenCV has no markers {target.dictionary!r}; expected such as 4X4_50, 5X5_100"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(markers)
    n_markers = len(dictionary.bytesList)
    if target.number >= n_markers:
        raise ConfigError(
            f"{target.dictionary} has no marker {target.number}; the last is {n_markers - 1}"
        )
    return dictionary


def _tag_detector(
    cv2: Any, dictionary: Any, border_bits: int, corners: FloatArray
) -> _Detector:
    """Return the detector of separate markers, whose black border is ``border_bits`` cells wide."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return _Detector(
        cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers, corners
    )


def _detect_chessboard(cv2: Any, target: Target, image: Any) -> tuple[Any, Any]:
    """Return pixels and numbers of the inner corners of a chessboard, or None twice."""
    is_found, pixels = cv2.findChessboardCornersSB(
        image, (target.columns, target.rows)
    )
    if not is_found:
        return None, None
    return pixels, np.arange(len(pixels))


def _chessboard_corners(target: Target) -> FloatArray:
    """Return the inner corners (n, 1, 3) of a chessboard row by row, m."""
    numbers = np.arange(target.columns * target.rows)
    y, x = np.divmod(numbers, target.columns)
    places = target.size * np.stack([x, y, 0 * x], axis=-1)
    return places[:, None]


def _marker_corners(target: Target) -> FloatArray:
    """Return the corners (1, 4, 3) of a single marker in OpenCV's order, m.

    The origin is the centre of the marker.
    """
    signs = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    square = target.size * signs / 2
    return square[None]


def _aprilgrid_corners(target: Target) -> FloatArray:
    """Return the corners (tags, 4, 3) of an AprilGrid in OpenCV's order, m.

    The tags begin at the lower left, row by row upward. In OpenCV, the tags of this family are
    upside down, so that the corners of a tag begin at its lower right, and follow clockwise.
    """
    unit_square = np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]])
    square = target.size * unit_square
    numbers = np.arange(target.columns * target.rows)
    y, x = np.divmod(numbers, target.columns)
    places = (target.size + target.marker) * np.stack([x, y, 0 * x], axis=-1)
    return places[:, None] + square


def _opencv() -> Any:
    # A file of 1 MB may unpack to more than the memory. OpenCV reads this limit at its import.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MOST_PIXELS))
    cv2 = required("cv2", "finding a target in images", "camera")
    if not hasattr(cv2.aruco, "CharucoDetector"):
        raise MissingDependencyError(
            f"poses from images of a target need OpenCV 4.7 or newer: {installing('camera')}"
        )
    return cv2
