"""Poses of a camera from images of a target: a ChArUco board, or an AprilGrid as of Kalibr."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import ConfigError, InputError, MissingDependencyError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import LARGEST_YAML

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")

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


@dataclass(frozen=True)
class Target:
    """A flat target; lengths in metres.

    Attributes
    ----------
    kind : str
        "charuco" or "aprilgrid".
    columns, rows : int
        Squares of a ChArUco board, tags of an AprilGrid.
    size, marker : float
        Side of a square and of its marker; side of a tag and the gap between two of them.
    dictionary : str
        Of the markers, as OpenCV names it without ``DICT_``.
    """

    kind: str
    columns: int
    rows: int
    size: float
    marker: float
    dictionary: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``charuco:5x7:0.04:0.03:4X4_50`` or ``aprilgrid:6x6:0.088:0.0264``.

        Raises
        ------
        ConfigError
            If it is no target.
        """
        kind, *parts = text.split(":")
        try:
            columns, rows = map(int, parts[0].split("x"))
            size, marker = map(float, parts[1:3])
        except (IndexError, ValueError):
            raise ConfigError(f"expected a target: {_EXPECTED_TARGET}; got {text!r}") from None
        dictionary = parts[3] if len(parts) == 4 else "4X4_50"
        is_right = 2 <= columns <= 100 and 2 <= rows <= 100 and marker > 0 and 0 < size < 100
        if kind == "charuco" and is_right and marker < size and len(parts) <= 4:
            return cls(kind, columns, rows, size, marker, dictionary)
        if kind == "aprilgrid" and is_right and len(parts) == 3:
            return cls(kind, columns, rows, size, marker, "APRILTAG_36h11")
        raise ConfigError(f"expected a target: {_EXPECTED_TARGET}; got {text!r}")


@dataclass(frozen=True)
class Camera:
    """Intrinsics: matrix (3, 3) in pixels, and distortion by OpenCV's models, or of a fisheye."""

    matrix: FloatArray
    distortion: FloatArray
    is_fisheye: bool

    @classmethod
    def of_numbers(cls, matrix: Sequence[float], distortion: Sequence[float], model: str) -> Self:
        """From row-major numbers and the name of a distortion model."""
        numbers = np.array(matrix, dtype=float)
        if numbers.size == 4:
            fu, fv, pu, pv = numbers
            numbers = np.array([fu, 0, pu, 0, fv, pv, 0, 0, 1.0])
        if numbers.size != 9 or not np.isfinite(numbers).all() or numbers[0] <= 0.0:
            raise InputError(f"expected {_EXPECTED_CAMERA}")
        coefficients = np.array(distortion, dtype=float).ravel()
        is_fisheye = model in ("equidistant", "fisheye")
        return cls(numbers.reshape(3, 3), coefficients, is_fisheye)


def read_camera(path: str | Path) -> Camera:
    """Read intrinsics from YAML of ROS, Kalibr or OpenCV.

    Raises
    ------
    InputError
        If the file cannot be read, or has none.
    """
    from hand_eye_calib.io.yaml_files import parse_foreign_yaml

    text = read_text(Path(path), _EXPECTED_CAMERA, LARGEST_YAML)
    document: Any = parse_foreign_yaml(text, str(path))
    if isinstance(document, Mapping):
        document = document.get("cam0", document)
    try:
        model = str(document.get("distortion_model", ""))
        if "intrinsics" in document:
            return Camera.of_numbers(document["intrinsics"], document["distortion_coeffs"], model)
        names = ("camera_matrix", "distortion_coefficients")
        matrix, distortion = (_data(document[name]) for name in names)
        return Camera.of_numbers(matrix, distortion, model)
    except (AttributeError, KeyError, TypeError, ValueError, InputError):
        raise InputError(f"{path}: expected {_EXPECTED_CAMERA}") from None


def _data(value: Any) -> Any:
    return value["data"] if isinstance(value, Mapping) else value


class TargetPoses(NamedTuple):
    """Poses (N, 4, 4) of the camera in the frame of the target, of the images in which it is seen;
    the indices (N,) of these, and by how many pixels (rms) their corners are missed.
    """

    Ts_target_camera: FloatArray
    images: list[int]
    rms_px: FloatArray


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, numbers by their value."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(found, key=lambda path: [int(x) if x.isdigit() else x for x in _parts(path.name)])


def _parts(name: str) -> list[str]:
    return re.split(r"(\d+)", name)


def read_images(paths: Iterable[Path]) -> Iterable[Any]:
    """Images in grey, one at a time."""
    cv2 = _opencv()
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputError(f"{path} is not an image that can be read")
        yield image


def poses_of_target(images: Iterable[Any], target: Target, camera: Camera) -> TargetPoses:
    """Find the target in grey images, and the pose of the camera from its corners.

    Raises
    ------
    InputError
        If no image shows the target.
    MissingDependencyError
        If OpenCV is not installed.
    """
    cv2 = _opencv()
    detect = _detector(cv2, target)
    found: list[tuple[FloatArray, int, float]] = []
    number = -1
    for number, image in enumerate(images):
        corners, pixels = detect(image)
        if len(corners) < _FEWEST_CORNERS:
            continue
        T_camera_target, rms_px = _pose(cv2, corners, pixels, camera)
        if rms_px <= _LARGEST_RMS_PX:
            found.append((se3.inverse(T_camera_target), number, rms_px))
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
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        corners, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    best, least = np.eye(4), np.inf
    for turn, shift in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(corners, rays, np.eye(3), None, turn, shift)
        T = se3.from_rotation_translation(cv2.Rodrigues(turn)[0], shift.ravel())
        seen = corners @ T[:3, :3].T + T[:3, 3]
        off = (seen[:, :2] / seen[:, 2:] - rays) * camera.matrix[[0, 1], [0, 1]]
        rms = float(np.sqrt((off**2).sum(axis=1).mean()))
        if rms < least:
            best, least = T, rms
    return best, least


def _detector(cv2: Any, target: Target) -> Any:
    """A function from a grey image to corners (N, 3) of the target and their pixels (N, 2)."""
    aruco = cv2.aruco
    try:
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{target.dictionary}"))
    except AttributeError:
        raise ConfigError(
            f"OpenCV has no markers {target.dictionary!r}; expected such as 4X4_50, 5X5_100"
        ) from None
    if target.kind == "charuco":
        size = (target.columns, target.rows)
        board = aruco.CharucoBoard(size, target.size, target.marker, dictionary)
        charuco = aruco.CharucoDetector(board)
        places = np.asarray(board.getChessboardCorners(), dtype=float)

        def corners_of_board(image: Any) -> tuple[FloatArray, FloatArray]:
            pixels, ids, _, _ = charuco.detectBoard(image)
            if ids is None:
                return np.empty((0, 3)), np.empty((0, 2))
            return places[ids.ravel()], np.asarray(pixels, dtype=float).reshape(-1, 2)

        return corners_of_board

    parameters = aruco.DetectorParameters()
    parameters.markerBorderBits = 2  # Kalibr's tags have a border of two bits
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    markers = aruco.ArucoDetector(dictionary, parameters)
    # From the lower left tag on, rows upward. OpenCV has the tags of this family upside down: their
    # corners come from the lower right one on, clockwise.
    step = target.size + target.marker
    square = target.size * np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]])

    def corners_of_tags(image: Any) -> tuple[FloatArray, FloatArray]:
        pixels, ids, _ = markers.detectMarkers(image)
        known = [
            (square + step * np.array([k % target.columns, k // target.columns, 0]), quad[0])
            for k, quad in zip(ids.ravel() if ids is not None else [], pixels, strict=False)
            if k < target.columns * target.rows
        ]
        if not known:
            return np.empty((0, 3)), np.empty((0, 2))
        corners, seen = (np.concatenate(each) for each in zip(*known, strict=True))
        return corners, seen.astype(float)

    return corners_of_tags


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise MissingDependencyError(
            "poses from images of a target need OpenCV, which is not installed: pip install "
            "'hand_eye_calib[camera]'"
        ) from None
    if not hasattr(cv2.aruco, "CharucoDetector"):
        raise MissingDependencyError(
            f"poses from images of a target need OpenCV 4.7 or newer; found {cv2.__version__}"
        )
    return cv2
