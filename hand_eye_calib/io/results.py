"""Calibrations in files: ``extrinsic.yaml`` with everything, and what a robot needs of it as xacro
and as launch file.
"""

import hashlib
import os
import platform
import threading
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from xml.sax.saxutils import quoteattr

import yaml

from hand_eye_calib.calibration import Calibration, SolveStatus
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3

FILE_NAME = "extrinsic.yaml"
XACRO_NAME = "extrinsic.urdf.xacro"
LAUNCH_NAME = "static_transform.launch.py"


def save_result(calibration, directory, inputs=None):
    """Write ``extrinsic.yaml``, ``extrinsic.urdf.xacro`` and ``static_transform.launch.py``.

    Each in one step: a reader sees the old file or the new one, never half of it. Where one cannot
    be written, none changes.

    Parameters
    ----------
    calibration : Calibration
    directory : str or path-like
        Made where it is missing.
    inputs : mapping, optional
        Where the data came from, in plain values; it goes into the file's provenance. Its
        ``options`` are the parameters there.

    Returns
    -------
    pathlib.Path
        ``extrinsic.yaml``.

    Raises
    ------
    InputError
        Where they cannot be written.
    """
    inputs = dict(inputs or {})
    provenance = {
        "package": "hand_eye_calib",
        "package_version": _package_version(),
        "versions": _versions(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "parameters": inputs.pop("options", {}),
        "inputs": inputs,
    }
    document = calibration.to_dict() | {"provenance": provenance}
    texts = {
        XACRO_NAME: _xacro_text(calibration),
        LAUNCH_NAME: _launch_text(calibration),
        FILE_NAME: yaml.safe_dump(
            document, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
        ),
    }
    directory = Path(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        replace_files({directory / name: text for name, text in texts.items()})
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or directory}: {error.strerror}; choose another directory"
        ) from None
    return directory / FILE_NAME


def keep_earlier_results(directory):
    """Copy the result files in a directory into its folder ``previous``, before they are replaced
    by those of another session.

    Raises
    ------
    InputError
        Where they cannot be copied.
    """
    directory = Path(directory)
    previous = directory / "previous"
    for name in (XACRO_NAME, LAUNCH_NAME, FILE_NAME):
        try:
            if (directory / name).exists():
                previous.mkdir(exist_ok=True)
                replace_file(previous / name, (directory / name).read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(
                f"cannot keep {directory / name} in {previous}: {error.strerror}"
            ) from None


def fingerprint(path):
    """Name, size and SHA-256 of an input file, for the provenance; read piece by piece.

    Raises
    ------
    InputError
        Where it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            return {"file": str(path), "bytes": file.tell(), "sha256": digest}
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None


def load_result(path):
    """Read a calibration that :func:`save_result` wrote.

    Parameters
    ----------
    path : str or path-like
        The file, or the directory that holds it.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Where it cannot be read, is no calibration or is of an unknown version.
    """
    path = Path(path)
    if path.is_dir():
        path = path / FILE_NAME
    try:
        return Calibration.from_dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}; expected a result or the directory of one"
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def replace_file(path, text):
    """Write a text file in one step; see :func:`replace_files`."""
    replace_files({path: text})


def replace_files(texts):
    """Write text files, each in one step, once all of them are on the disk under other names.

    Parameters
    ----------
    texts : mapping of pathlib.Path to str

    Raises
    ------
    OSError
        Where one cannot be written, by its name; what was there stays.
    """
    temporaries = {
        path: path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
        for path in texts
    }
    try:
        for path, temporary in temporaries.items():
            with open(temporary, "w", encoding="utf-8") as file:
                file.write(texts[path])
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)


def _xacro_text(calibration):
    """A fixed joint from the parent's to the child's link, for a robot description that has both
    links.
    """
    transform = calibration.to_dict()["T_parent_child"]
    parent, child = (
        _xacro_attribute(frame) for frame in (calibration.parent_frame, calibration.child_frame)
    )
    joint = _xacro_attribute(f"{calibration.parent_frame}_to_{calibration.child_frame}")
    xyz, rpy = (
        " ".join(map(repr, values)) for values in (transform["translation"], _rpy_rad(calibration))
    )
    comment = "\n".join(f"     {line}" for line in _remarks(calibration)).replace("--", "- -")
    return f"""\
<?xml version="1.0" encoding="UTF-8"?>
<!-- Include this file in the robot's description, which has both links.
{comment} -->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <joint name={joint} type="fixed">
    <parent link={parent}/>
    <child link={child}/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
  </joint>
</robot>
"""


def _launch_text(calibration):
    """A launch file that publishes the extrinsic as a static transform."""
    transform = calibration.to_dict()["T_parent_child"]
    values = zip(
        ("x", "y", "z", "qx", "qy", "qz", "qw"),
        transform["translation"] + transform["quat_xyzw"],
        strict=True,
    )
    arguments = [(f"--{name}", f"{round(value, 12) + 0.0:.12f}") for name, value in values]
    arguments += [
        ("--frame-id", calibration.parent_frame),
        ("--child-frame-id", calibration.child_frame),
    ]
    lines = "\n".join(f"                    {option!r}, {value!r}," for option, value in arguments)
    comment = "\n".join(f"# {line}" for line in _remarks(calibration))
    return f"""\
# Publishes the extrinsic on /tf_static. Only where no robot description has this edge: a frame has one parent and one publisher.
{comment}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package='tf2_ros',
                executable='static_transform_publisher',
                arguments=[
{lines}
                ],
            )
        ]
    )
"""


def _remarks(calibration):
    """What a person who opens the file must know, in lines."""
    remarks = [
        f"Pose of {calibration.child_frame} in {calibration.parent_frame}: maps coordinates of {calibration.child_frame} into "
        f"{calibration.parent_frame}.",
        f"Made by hand_eye_calib {_package_version()}; {FILE_NAME} beside this file has the covariance and where it came from.",
    ]
    if calibration.status is not SolveStatus.OK:
        names = ", ".join(calibration.unobservable())
        what = f"the motion does not reveal {names}" if names else "the solver did not converge"
        remarks.append(f"DO NOT USE AS IT IS: {what}.")
    return [" ".join(remark.split()) for remark in remarks]


def _rpy_rad(calibration):
    """Rotation about the parent's fixed axes x, y, z, as URDF has it."""
    return se3.rotation_to_rpy(calibration.T_parent_child[:3, :3]).tolist()


def _xacro_attribute(text):
    """Quoted for XML, and kept from being evaluated by xacro."""
    return quoteattr(text.replace("$", "$$"))


def _versions():
    return {"python": platform.python_version()} | {
        name: metadata.version(name) for name in ("numpy", "scipy")
    }


def _package_version():
    try:
        return metadata.version("hand_eye_calib")
    except metadata.PackageNotFoundError:
        return "not installed"
