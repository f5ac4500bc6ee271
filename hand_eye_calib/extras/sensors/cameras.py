"""Intrinsics of cameras, from files of ROS, Kalibr, OpenCV and ViSP, and from CameraInfo."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.formats.files import read_bytes
from hand_eye_calib.formats.yaml_files import read_yaml

_EXPECTED_CAMERA = (
    "the intrinsics of a camera: camera_info of ROS, camchain of Kalibr, camera_matrix and "
    "distortion_coefficients of OpenCV, or XML of ViSP"
)
# Models of distortion, and whether they are those of a fisheye.
_IS_FISHEYE = {
    "": False,
    "none": False,
    "plumb_bob": False,
    "radtan": False,
    "rational_polynomial": False,
    "equidistant": True,
    "fisheye": True,
}


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera.

    Attributes
    ----------
    matrix : (3, 3) array
        Camera matrix: focal lengths and principal point, pixels.
    distortion : (n,) array
        Coefficients of OpenCV's models.
    is_fisheye : bool
    """

    matrix: FloatArray
    distortion: FloatArray
    is_fisheye: bool

    @classmethod
    def of(
        cls, where: object, matrix: Any, distortion: Any, model: str = ""
    ) -> Self:
        """Return a camera from the 9 numbers of its matrix, its distortion, and the model's name.

        Raises
        ------
        InputError
            If these values are not those of a camera. ``where`` names their source in the message.
        """
        try:
            numbers = np.array(matrix, dtype=float).reshape(3, 3)
            if not np.isfinite(numbers).all() or numbers[0, 0] <= 0.0:
                raise ValueError("no focal length")
            return cls(
                numbers,
                np.array(distortion, dtype=float).ravel(),
                _IS_FISHEYE[model],
            )
        except (KeyError, TypeError, ValueError):
            models = ", ".join(model for model in _IS_FISHEYE if model)
            raise InputError(
                f"{where}: expected {_EXPECTED_CAMERA}; models are {models}"
            ) from None


def read_camera(path: str | Path) -> Camera:
    """Read intrinsics from YAML of ROS, Kalibr or OpenCV, or from XML of ViSP.

    Raises
    ------
    InputError
        If there are none.
    """
    if Path(path).suffix.lower() == ".xml":
        return _camera_of_visp(Path(path))
    document: Any = read_yaml(path, _EXPECTED_CAMERA)
    try:
        document = document.get("cam0", document)
        if "intrinsics" in document:
            fu, fv, pu, pv = document["intrinsics"]
            matrix = [fu, 0, pu, 0, fv, pv, 0, 0, 1]
            distortion = document["distortion_coeffs"]
        else:
            matrix = _entries(document["camera_matrix"])
            distortion = _entries(document["distortion_coefficients"])
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: expected {_EXPECTED_CAMERA}") from None
    return Camera.of(
        path, matrix, distortion, document.get("distortion_model", "")
    )


def _camera_of_visp(path: Path) -> Camera:
    """Read the intrinsics of a file of ViSP, with distortion if the file has such a model.

    ViSP's ``kud`` is the coefficient of the squared radius, as OpenCV's k1.
    """
    try:
        models = list(
            ElementTree.fromstring(read_bytes(path)).iterfind(".//model")
        )
        by_type = {model.findtext("type", ""): model for model in models}
        plain = by_type.get("perspectiveProjWithoutDistortion")
        model = by_type.get("perspectiveProjWithDistortion", plain)
        if model is None or len(by_type) < len(models):
            raise ValueError("no model, or models of several cameras")
        focal_x = float(model.findtext("px", ""))
        focal_y = float(model.findtext("py", ""))
        centre_x = float(model.findtext("u0", ""))
        centre_y = float(model.findtext("v0", ""))
        k1 = float(model.findtext("kud", "0"))
    except (ElementTree.ParseError, ValueError):
        raise InputError(
            f"{path}: expected {_EXPECTED_CAMERA}, of one camera"
        ) from None
    matrix = [focal_x, 0.0, centre_x, 0.0, focal_y, centre_y, 0.0, 0.0, 1.0]
    return Camera.of(path, matrix, [k1, 0.0, 0.0, 0.0])


def _entries(matrix: Any) -> Any:
    """Return the numbers of a matrix in YAML, which ROS and OpenCV write as a mapping."""
    return matrix["data"] if isinstance(matrix, Mapping) else matrix


def camera_of(info: Any, is_rectified: bool, where: str) -> Camera:
    """Return the intrinsics of a CameraInfo message.

    For rectified images, they are those of the message's projection matrix P, without distortion.
    """
    is_ros1 = hasattr(info, "K")
    if is_rectified:
        projection = np.reshape(info.P if is_ros1 else info.p, (3, 4))
        return Camera.of(where, projection[:, :3], [])
    if is_ros1:
        return Camera.of(where, info.K, info.D, info.distortion_model)
    return Camera.of(where, info.k, info.d, info.distortion_model)
