"""Markers of a result for RViz and Foxglove, in the parent sensor's frame."""

from collections.abc import Iterator

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import AXIS_UNITS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.ros.conversions import fill, to_time

# Length and width (m) of the drawn axes of a sensor; config/calibrator.rviz draws frames alike.
_AXIS_LENGTH_M = 0.2
_AXIS_WIDTH_M = 0.01
# Height of a line of text (m).
_TEXT_M = 0.04

# Radius of the ellipsoid, in standard deviations.
_SIGMAS = 3.0
# Smallest radius (m) of the ellipsoid. A smaller ellipsoid is invisible.
_MIN_RADIUS_M = 1e-3
# Largest radius (m) of the ellipsoid. That of an unobservable axis would hide the scene.
_MAX_RADIUS_M = 1.0

_RED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=1.0)
_GREEN = ColorRGBA(r=0.1, g=0.7, b=0.1, a=1.0)
_BLUE = ColorRGBA(r=0.1, g=0.3, b=0.9, a=1.0)
_YELLOW = ColorRGBA(r=0.9, g=0.7, b=0.1, a=1.0)
_GREY = ColorRGBA(r=0.6, g=0.6, b=0.6, a=1.0)
_COLOURS = {
    Verdict.USE: _GREEN,
    Verdict.USE_WITH_CARE: _YELLOW,
    Verdict.DO_NOT_USE: _RED,
}


def to_markers(calibration: Calibration | None) -> MarkerArray:
    """Return the markers of a result as visualization_msgs/MarkerArray.

    These are the namespaces of the markers:

    - ``parent`` and ``child``: axes of the sensors.
    - ``uncertainty``: ellipsoid of three standard deviations of the child's position.
    - ``text``: verdict and values.
    - ``installed``: grey axes of the child sensor in its installed pose, if the result was compared
      with this pose.

    Without a result, the message only deletes the markers of earlier results.
    """
    message = MarkerArray()
    # RViz shows a marker until it is deleted, and the new result may have fewer markers.
    message.markers.append(Marker(action=Marker.DELETEALL))
    if calibration is not None:
        for marker in _markers(calibration):
            marker.header.frame_id = calibration.parent_frame
            marker.header.stamp = to_time(calibration.stamp_ns)
            message.markers.append(marker)
    return message


def _markers(calibration: Calibration) -> Iterator[Marker]:
    """Yield the markers of a result without their headers."""
    T_parent_child = calibration.T_parent_child
    axis_colours = [_RED, _GREEN, _BLUE]
    yield _axes("parent", np.eye(4), axis_colours)
    yield _axes("child", T_parent_child, axis_colours)
    yield _ellipsoid(calibration)
    yield _text(calibration)
    installed = calibration.comparison and calibration.comparison.values
    if installed:
        xyz = [installed[axis] for axis in AXES[:3]]
        rotation = se3.rotation_from_rpy([installed[axis] for axis in AXES[3:]])
        T_parent_installed = se3.from_rotation_translation(rotation, xyz)
        yield _axes("installed", T_parent_installed, [_GREY] * 3)


def _axes(
    namespace: str, T_parent_sensor: FloatArray, colours: list[ColorRGBA]
) -> Marker:
    """Return three lines of the colours: x, y and z axis of a sensor in the parent's frame."""
    marker = Marker(ns=namespace, type=Marker.LINE_LIST)
    marker.scale.x = _AXIS_WIDTH_M
    fill(marker.pose.position, marker.pose.orientation, T_parent_sensor)
    for direction, colour in zip(
        _AXIS_LENGTH_M * np.eye(3), colours, strict=True
    ):
        x, y, z = direction.tolist()
        marker.points += [Point(), Point(x=x, y=y, z=z)]
        marker.colors += [colour, colour]
    return marker


def _ellipsoid(calibration: Calibration) -> Marker:
    """Return the ellipsoid of the child's position, in the colour of the verdict."""
    T_parent_child = calibration.T_parent_child
    rotation = se3.rotation_of(T_parent_child)
    covariance = turned(rotation, calibration.covariance)[:3, :3]
    variances, directions = np.linalg.eigh(covariance)
    # Eigenvectors may be left-handed; a rotation is right-handed.
    directions[:, 2] *= np.linalg.det(directions)
    radii_m = _SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    diameters_m = 2.0 * np.clip(radii_m, _MIN_RADIUS_M, _MAX_RADIUS_M)
    marker = Marker(ns="uncertainty", type=Marker.SPHERE)
    T_parent_ellipsoid = se3.from_rotation_translation(
        directions, se3.translation_of(T_parent_child)
    )
    fill(marker.pose.position, marker.pose.orientation, T_parent_ellipsoid)
    marker.scale.x, marker.scale.y, marker.scale.z = diameters_m.tolist()
    colour = _COLOURS[calibration.verdict]
    marker.color = ColorRGBA(r=colour.r, g=colour.g, b=colour.b, a=0.3)
    return marker


def _text(calibration: Calibration) -> Marker:
    """Return frames, verdict and pose as a text above the child sensor."""
    lines = [
        f"{calibration.child_frame} in {calibration.parent_frame}",
        calibration.verdict.value,
    ]
    values = se3.xyz_rpy(calibration.T_parent_child).tolist()
    for axis, value, sigma in zip(
        AXES, values, calibration.sigmas_printed, strict=True
    ):
        if AXIS_UNITS[axis] == "rad":
            lines.append(
                f"{axis} {np.degrees(value):.2f} +/- {np.degrees(sigma):.2f} deg"
            )
        else:
            lines.append(f"{axis} {value:.3f} +/- {sigma:.3f} m")
    marker = Marker(
        ns="text", type=Marker.TEXT_VIEW_FACING, text="\n".join(lines)
    )
    x, y, z = se3.translation_of(calibration.T_parent_child).tolist()
    marker.pose.position = Point(
        x=x, y=y, z=z + _AXIS_LENGTH_M + len(lines) * _TEXT_M / 2.0
    )
    marker.scale.z = _TEXT_M
    marker.color = _COLOURS[calibration.verdict]
    return marker
