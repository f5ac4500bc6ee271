"""Poses of a camera from images of a target: a ChArUco board, or an AprilGrid as of Kalibr."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import ConfigError, InputError, MissingDependencyError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.yaml_files import read_yaml

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")

# An image needs so many corners of the target, and may miss them by so much (pixels, rms).
_FEWEST_CORNERS, _LARGEST_RMS_PX = 8, 5.0

_EXPECTED_TARGET = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], such as charuco:5x7:0.04:0.03:4X4_50, or "
    "aprilgrid:COLUMNSxROWS:TAG:GAP, such as aprilgrid:6x6:0.088:0.0264; lengths in metres"
)
_EXPECTED_CAMERA = (
    "the intrinsics of a camera: camera_info of ROS, camchain of Kalibr, or camera_matrix and "
    "distortion_coefficients of OpenCV"
)

# Finds corners (N, 3) of the target, m, and their pixels (N, 2) in a grey image.
_Detector = Callable[[Any], tuple[FloatArray, FloatArray]]


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


def read_camera(path: str | Path) -> Camera:
    """Read intrinsics from YAML of ROS, Kalibr or OpenCV; an InputError if there are none."""
    document: Any = read_yaml(path, _EXPECTED_CAMERA)
    try:
        document = document.get("cam0", document)
        if "intrinsics" in document:
            fu, fv, pu, pv = document["intrinsics"]
            matrix, distortion = [fu, 0, pu, 0, fv, pv, 0, 0, 1], document["distortion_coeffs"]
        else:
            matrix, distortion = (
                value["data"] if isinstance(value, Mapping) else value
                for value in (document["camera_matrix"], document["distortion_coefficients"])
            )
        numbers = np.array(matrix, dtype=float).reshape(3, 3)
        coefficients = np.array(distortion, dtype=float).ravel()
        if not np.isfinite(numbers).all() or numbers[0, 0] <= 0.0:
            raise ValueError("no focal length")
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: expected {_EXPECTED_CAMERA}") from None
    is_fisheye = document.get("distortion_model") in ("equidistant", "fisheye")
    return Camera(numbers, coefficients, is_fisheye)


class TargetPoses(NamedTuple):
    """Poses (N, 4, 4) of the target in the camera, of the images in which it is seen; the indices
    (N,) of these, and by how many pixels (rms) their corners are missed.
    """

    Ts_camera_target: FloatArray
    images: list[int]
    rms_px: FloatArray


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, numbers by their value."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in _IMAGE_SUFFIXES]
    numbers = re.compile(r"(\d+)")
    return sorted(
        found, key=lambda path: [int(x) if x.isdigit() else x for x in numbers.split(path.name)]
    )


def read_images(paths: Iterable[Path]) -> Iterable[Any]:
    """Images in grey, one at a time."""
    cv2 = _opencv()
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputError(f"{path} is not an image that can be read")
        yield image


def poses_of_target(images: Iterable[Any], target: Target, camera: Camera) -> TargetPoses:
    """Find the target in grey images, and its pose from its corners; an InputError if no image
    shows it.
    """
    cv2 = _opencv()
    markers = getattr(cv2.aruco, f"DICT_{target.dictionary}", None)
    if markers is None:
        raise ConfigError(
            f"OpenCV has no markers {target.dictionary!r}; expected such as 4X4_50, 5X5_100"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(markers)
    detect = (_board if target.kind == "charuco" else _tags)(cv2, target, dictionary)
    found: list[tuple[FloatArray, int, float]] = []
    number = -1
    for number, image in enumerate(images):
        corners, pixels = detect(image)
        if len(corners) >= _FEWEST_CORNERS:
            T_camera_target, rms_px = _pose(cv2, corners, pixels, camera)
            if rms_px <= _LARGEST_RMS_PX:
                found.append((T_camera_target, number, rms_px))
    if not found:
        raise InputError(
            f"none of {number + 1} images shows at least {_FEWEST_CORNERS} corners of the target "
            f"{target.kind} {target.columns}x{target.rows} of {target.dictionary}"
        )
    poses, numbers, rms = zip(*found, strict=True)
    return TargetPoses(np.stack(poses), list(numbers), np.array(rms))


def _pose(
    cv2: Any, corners: FloatArray, pixels: FloatArray, camera: Camera
) -> tuple[FloatArray, float]:
    """Pose of the target in the camera, and the rms error of its corners in pixels. Of the two
    poses that a flat target nearly fits, the better one.
    """
    undistort = cv2.fisheye.undistortPoints if camera.is_fisheye else cv2.undistortPoints
    rays = undistort(pixels.reshape(-1, 1, 2), camera.matrix, camera.distortion).reshape(-1, 2)
    ideal = np.eye(3), None
    _, turns, shifts, _ = cv2.solvePnPGeneric(corners, rays, *ideal, flags=cv2.SOLVEPNP_IPPE)
    found = []
    for start in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(corners, rays, *ideal, *start)
        T = se3.from_rotation_translation(cv2.Rodrigues(turn)[0], shift.ravel())
        seen = corners @ T[:3, :3].T + T[:3, 3]
        off = (seen[:, :2] / seen[:, 2:] - rays) * camera.matrix[[0, 1], [0, 1]]
        found.append((T, float(np.sqrt((off**2).sum(axis=1).mean()))))
    return min(found, key=lambda each: each[1])


def _board(cv2: Any, target: Target, dictionary: Any) -> _Detector:
    """Finds the corners of a ChArUco board."""
    size = (target.columns, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.size, target.marker, dictionary)
    charuco = cv2.aruco.CharucoDetector(board)
    places = np.asarray(board.getChessboardCorners(), dtype=float)

    def detect(image: Any) -> tuple[FloatArray, FloatArray]:
        pixels, ids, _, _ = charuco.detectBoard(image)
        if ids is None:
            return np.empty((0, 3)), np.empty((0, 2))
        return places[ids.ravel()], np.asarray(pixels, dtype=float).reshape(-1, 2)

    return detect


def _tags(cv2: Any, target: Target, dictionary: Any) -> _Detector:
    """Finds the corners of the tags of an AprilGrid."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2  # Kalibr's tags have a border of two bits
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = cv2.aruco.ArucoDetector(dictionary, parameters)
    # From the lower left tag on, rows upward. OpenCV has the tags of this family upside down: their
    # corners come from the lower right one on, clockwise.
    step = target.size + target.marker
    square = target.size * np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]])

    def detect(image: Any) -> tuple[FloatArray, FloatArray]:
        quads, ids, _ = markers.detectMarkers(image)
        places, pixels = [np.empty((0, 3))], [np.empty((0, 2))]
        for k, quad in zip([] if ids is None else ids.ravel(), quads, strict=False):
            row, column = divmod(int(k), target.columns)
            if row < target.rows:
                places.append(square + step * np.array([column, row, 0]))
                pixels.append(quad[0])
        return np.concatenate(places), np.concatenate(pixels)

    return detect


def _opencv() -> Any:
    try:
        import cv2

        cv2.aruco.CharucoDetector  # noqa: B018
    except (ImportError, AttributeError):
        raise MissingDependencyError(
            "poses from images of a target need OpenCV 4.7 or newer: pip install "
            "'hand_eye_calib[camera]'"
        ) from None
    return cv2
