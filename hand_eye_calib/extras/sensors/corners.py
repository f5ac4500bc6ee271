"""Draw the corners of a target on its images: as detected, and as predicted by the result."""

import base64
import html
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import printable, required
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.sensors.cameras import Camera
from hand_eye_calib.extras.sensors.target_images import TargetPoses
from hand_eye_calib.offline.report.style import Drawn

_TITLE = "Corners of the target, through the result"
# Number of images in the figure, with the best and the worst stop.
_N_IMAGES = 4
# Width and height of an image in the figure, and the space around it (units of the SVG, which are
# pixels of the image in the page).
_WIDTH = 440
_HEIGHT = 330
_MARGIN = 30
# Space around the corners in an image, as a share of their extent.
_AROUND = 0.15
# Quality of an image as JPEG, 0 to 100.
_QUALITY = 70
# Radius of a circle around a detected corner (units of the SVG).
_RADIUS = 6.0


class Reprojection(NamedTuple):
    """Corners of the target at a stop, in pixels of the image.

    Attributes
    ----------
    detected, predicted : (n, 2) arrays
        Detected corners, and the same corners at the pose of the target that follows from the pose
        of the robot and the result.
    rms_px : float
        Root mean square of their distances.
    """

    detected: FloatArray
    predicted: FloatArray
    rms_px: float


def reprojections(
    calibration: Calibration, detections: TargetPoses, camera: Camera
) -> list[Reprojection]:
    """Return the detected and the predicted corners at each stop.

    The list is empty if the result does not use the detected poses as they are.
    """
    residuals = calibration.motion_residuals
    if residuals is None or len(residuals) != len(detections.images):
        return []
    Ts = detections.Ts_camera_target.copy()
    # The fit uses metres, but the target's lengths may be in another unit.
    Ts[:, :3, 3] *= calibration.scale
    Ts_target_camera = se3.inverse(Ts)
    positions = [stop.position_m for stop in calibration.parts["stops"].rows]
    if not np.allclose(se3.translation_of(Ts_target_camera), positions):
        return []
    X = calibration.T_parent_child
    T_method = X if calibration.T_method is None else calibration.T_method
    if calibration.hidden:
        # Values along unknown axes are no estimates.
        X = T_method
    # Residuals are errors xi of predicted = measured @ exp(xi), the translation in the parent's
    # axes.
    translations = residuals.translation @ se3.rotation_of(T_method)
    errors = se3.exp(np.hstack([translations, residuals.rotation]))
    predicted = Ts_target_camera @ errors @ se3.inverse(T_method) @ X
    Ts_camera_target = se3.inverse(predicted)
    Ts_camera_target[:, :3, 3] /= calibration.scale
    stops = []
    for T, corners, pixels in zip(
        Ts_camera_target, detections.corners, detections.pixels, strict=True
    ):
        projected = _projected(camera, T, corners)
        distances = np.linalg.norm(projected - pixels, axis=1)
        rms_px = float(np.sqrt(np.mean(distances**2)))
        stops.append(Reprojection(pixels, projected, rms_px))
    return stops


def _projected(
    camera: Camera, T: FloatArray, corners: FloatArray
) -> FloatArray:
    """Return the pixels (n, 2) of corners (n, 3) of the target at a pose (4, 4)."""
    cv2 = required("cv2", "drawing the corners of a target", "camera")
    project = (
        cv2.fisheye.projectPoints if camera.is_fisheye else cv2.projectPoints
    )
    vector = cv2.Rodrigues(T[:3, :3])[0]
    pixels, _ = project(
        corners[:, None], vector, T[:3, 3], camera.matrix, camera.distortion
    )
    return np.asarray(pixels).reshape(-1, 2)


def figures_of_corners(
    calibration: Calibration,
    detections: TargetPoses,
    camera: Camera,
    names: Sequence[str],
    read: Callable[[int], Any],
) -> list[Drawn]:
    """Return the figure of some images as a list, which is empty for a failed solve.

    Parameters
    ----------
    calibration : Calibration
        Result of the stops of an arm.
    detections : TargetPoses
    camera : Camera
    names : sequence of str
        Names of all images.
    read : callable
        ``read(index)`` returns an image in grey.
    """
    if calibration.has_failed:
        return []
    stops = reprojections(calibration, detections, camera)
    if not stops:
        return []
    sizes = np.array([stop.rms_px for stop in stops])
    order = np.argsort(sizes)
    ranks = np.linspace(0, len(order) - 1, min(_N_IMAGES, len(order)))
    # The worst stop is first.
    chosen = order[ranks.round().astype(int)[::-1]].tolist()
    worst = chosen[0]
    parts = []
    for place, row in enumerate(chosen):
        image_number = detections.images[row]
        label = f"stop {row + 1}, {names[image_number]}: {sizes[row]:.2g} px"
        if row == worst:
            label = f"worst: {label}"
        parts.append(_tile(place, label, read(image_number), stops[row]))
    rows = -(-len(chosen) // 2)
    width = 2 * _WIDTH + _MARGIN
    height = rows * (_HEIGHT + _MARGIN)
    svg = (
        f'<svg aria-hidden="true" focusable="false" viewBox="0 0 {width} {height}">'
        f"{''.join(parts)}</svg>"
    )
    is_left_out = not calibration.parts["stops"].rows[worst].is_used
    caption = (
        f"Circles: corners detected on the image. Crosses: the same corners where the pose of the "
        f"robot and the result put them. Each cross should be in its circle. Half of the "
        f"{len(stops)} stops agree to {np.median(sizes):.2g} pixels, the worst, stop {worst + 1}, "
        f"to {sizes[worst]:.2g} pixels{'; the fit leaves this stop out' if is_left_out else ''}."
    )
    key = (("parent", "detected"), ("child", "robot and result"))
    return [Drawn("corners", _TITLE, caption, svg, key)]


def _tile(place: int, label: str, image: Any, stop: Reprojection) -> str:
    """Return a part of an image with its corners and a label above, as SVG.

    ``place`` is the number of the part, from left to right and downwards.
    """
    cv2 = required("cv2", "drawing the corners of a target", "camera")
    low, high = _part_of_image(image.shape, stop.detected)
    part = image[low[1] : high[1], low[0] : high[0]]
    units_a_pixel = min(_WIDTH / part.shape[1], _HEIGHT / part.shape[0])
    size = np.array(part.shape[::-1]) * units_a_pixel
    n_pixels = tuple(size.round().astype(int).tolist())
    if n_pixels[0] < part.shape[1]:
        part = cv2.resize(part, n_pixels, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    encoded = base64.b64encode(data.tobytes()).decode()
    x = place % 2 * (_WIDTH + _MARGIN)
    y = place // 2 * (_HEIGHT + _MARGIN) + _MARGIN
    # The centre of a pixel has whole coordinates.
    detected, predicted = [
        (pixels - low + 0.5) * units_a_pixel
        for pixels in (stop.detected, stop.predicted)
    ]
    # A cross far outside would be drawn over other images.
    is_inside = ((predicted > 0) & (predicted < size)).all(axis=1)
    circles = "".join(
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{_RADIUS:g}"/>'
        for u, v in detected
    )
    arm = _RADIUS
    crosses = "".join(
        f"M{u - arm:.1f} {v:.1f}h{2 * arm:g}M{u:.1f} {v - arm:.1f}v{2 * arm:g}"
        for u, v in predicted[is_inside]
    )
    return (
        f'<g transform="translate({x} {y})">'
        f'<text y="-9" font-size="15" font-family="var(--sans)" fill="var(--ink)">'
        f"{_escaped(label)}</text>"
        f'<image width="{size[0]:.1f}" height="{size[1]:.1f}" '
        f'href="data:image/jpeg;base64,{encoded}"/>'
        f'<g fill="none" stroke="var(--parent)" stroke-width="2.2">{circles}</g>'
        f'<path fill="none" stroke="var(--child)" stroke-width="1.8" d="{crosses}"/></g>'
    )


def _part_of_image(shape: Sequence[int], pixels: FloatArray) -> tuple[Any, Any]:
    """Return the part of an image around some pixels (n, 2), as two corners (column, row).

    The second corner is the end, which is not in the part.
    """
    size = np.array([shape[1], shape[0]])
    extent = np.ptp(pixels, axis=0)
    half = (0.5 + _AROUND) * extent.max() * np.array([1.0, _HEIGHT / _WIDTH])
    half = np.maximum(half, (0.5 + _AROUND) * extent)
    center = (pixels.min(axis=0) + pixels.max(axis=0)) / 2
    low = np.clip(np.floor(center - half), 0, size - 1).astype(int)
    high = np.clip(np.ceil(center + half), low + 1, size).astype(int)
    return low, high


def _escaped(label: str) -> str:
    """Return a label as the text of an SVG."""
    return html.escape(printable(label))
