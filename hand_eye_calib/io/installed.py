"""What is installed now: from a robot description, an earlier result, a bag, or numbers."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.io.exports import SUFFIXES, open_export
from hand_eye_calib.io.results import FILE_NAME, load_result
from hand_eye_calib.io.urdf import RobotDescription
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import parse_pose

# Results say what they are, within so many bytes.
_FORMAT, _SEARCHED = b"hand_eye_calib/extrinsic", 65_536
_DESCRIPTIONS = (".urdf", ".xml", ".xacro")


def read_installed(text: str, parent_frame: str, child_frame: str) -> Extrinsic:
    """The installed pose of the child sensor in the parent sensor's frame.

    Parameters
    ----------
    text : str
        As of :func:`open_installed`, which says what is raised, too.
    parent_frame, child_frame : str
        The sensors' frames.

    Raises
    ------
    InputError
        If it does not have these frames.
    """
    return open_installed(text)(parent_frame, child_frame)


def open_installed(text: str) -> Callable[[str, str], Extrinsic]:
    """Read what is installed before the sensors' frames are known: the parent's and the child's
    give the pose of the child sensor in the parent sensor's frame, as :func:`read_installed`.

    Parameters
    ----------
    text : str
        A robot description (``.urdf``), a result (``extrinsic.yaml``, or its directory), a file of
        another program, one of results/exports.py, a bag with ``/tf_static``, or
        ``X Y Z ROLL PITCH YAW`` in m and rad.

    Raises
    ------
    InputError
        If it cannot be read.
    ConfigError
        If it is neither a file nor six numbers.
    """
    path = Path(text)
    try:
        exists = path.exists()
    except (OSError, ValueError):
        exists = False
    if not exists:
        numbers = _numbers(text)
        return lambda parent_frame, child_frame: numbers
    if (path / FILE_NAME).exists() or path.name == FILE_NAME or _is_result(path):
        return partial(_of_result, load_result(path), path)
    if path.suffix in SUFFIXES:
        return open_export(path).of
    is_description = path.suffix in _DESCRIPTIONS
    frames = RobotDescription(path).frames if is_description else frames_of_bag(path)
    return partial(of_frames, frames, origin=str(path))


def of_frames(frames: FrameTree, parent_frame: str, child_frame: str, origin: str) -> Extrinsic:
    """The installed pose that a tree of frames has.

    Raises
    ------
    InputError
        If the frames are not there, or move against each other.
    """
    try:
        return Extrinsic(frames.pose(parent_frame, child_frame), origin)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None


def frames_of_bag(path: str | Path) -> FrameTree:
    """The frames of a bag's ``/tf_static``."""
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(path) as bag:
        return bag.static_frames()


def _is_result(path: Path) -> bool:
    """Whether a file under another name is a result of this package."""
    try:
        with path.open("rb") as file:
            return path.suffix in (".yaml", ".yml") and _FORMAT in file.read(_SEARCHED)
    except OSError:
        return False


def _numbers(text: str) -> Extrinsic:
    try:
        values = parse_pose("installed", text)
    except ConfigError as error:
        raise ConfigError(
            "what is installed must be a file that exists (URDF, extrinsic.yaml, bag) or six "
            f"numbers in m and rad: {error}"
        ) from None
    rotation = se3.rotation_from_rpy(values[3:])
    return Extrinsic(se3.from_rotation_translation(rotation, values[:3]), text)


def _of_result(result: Calibration, path: Path, parent_frame: str, child_frame: str) -> Extrinsic:
    found, wanted = (result.parent_frame, result.child_frame), (parent_frame, child_frame)
    T, covariance = result.T_parent_child, result.covariance
    if found == wanted[::-1]:
        adjoint = se3.adjoint(T)
        T, covariance = result.T_child_parent, adjoint @ covariance @ adjoint.T
    elif found != wanted:
        raise InputError(
            f"{path}: is about {found[1]} in {found[0]}; expected {child_frame} in {parent_frame}"
        )
    return Extrinsic(T, str(path), covariance, is_calibration=True)
