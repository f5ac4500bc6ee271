"""Join the vertical that both sensors measure with the motion.

The extrinsic has the rotation R and the translation t. Both sensors measure the vertical (n_p, n_c)
and the height over the ground (h_p, h_c) at the same time:

    n_p = R n_c,    n_p . t = h_c - h_p.

If one sensor measures the ground and the other gravity, n_p and R n_c differ by the slope s of the
road. It turns with the heading, and the mount does not, so that both are estimated. The measurement
of X is joined by one step of a Kalman filter. Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan,
*Estimation with applications to tracking and navigation*, 2001, section 5.2.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import judged
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.base.stats import CHI2, MEDIAN_NORMAL, median, medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import sigmas_in_parent
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.verdict import CONTRADICTED_SIGMAS
from hand_eye_calib.extras.ground.part import GroundAxis, GroundResult
from hand_eye_calib.extras.ground.tracks import VerticalTrack

# Parts of the drive, equally long on the road. A third of them must have data.
_PARTS = 24

# Standard deviation of the slope of a road (rad): steep roads have 10 %.
_SLOPE = 0.05

# Constant errors that no drive reveals, as standard deviations of one sensor. They were measured on
# simulated drives with the errors that data sheets of rotating lidars state: 1 cm for ranges,
# 0.05 deg for elevations of beams.
_HEIGHT_M = 0.009
# Tilt (rad): of the ground by the same errors 0.035 deg. Data sheets of industrial IMUs state a
# bias of 2 mg, half of which averages out in curves.
_TILTS = {"ground": float(np.radians(0.035)), "gravity": 0.001}
# Tilt (rad) of a road that turns with the vehicle: the rest of a crown of 2 %, 0.15 deg.
_ROAD = float(np.radians(0.15))


class Measurement(NamedTuple):
    """Measurement of the extrinsic: ``jacobian @ xi = values``, xi = (rho, phi) of the child.

    Attributes
    ----------
    axes : tuple of str
        Axes of the parent that are nearest to the rows.
    values : (M,) array
        Differences (m, rad) from the extrinsic that the measurement is linearised at.
    jacobian : (M, 6) array
    covariance : (M, M) array
    """

    axes: tuple[str, ...]
    values: FloatArray
    jacobian: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class VerticalPair:
    """Verticals of both sensors: a measurement of the extrinsic beside motion."""

    parent: VerticalTrack
    child: VerticalTrack

    def joined(self, calibration: Calibration, snapshot: Any) -> Calibration:
        """Return a result joined with the verticals if they agree with the motion.

        Parameters
        ----------
        calibration : Calibration
            Result of the motion alone.
        snapshot : Snapshot
            The streams of the result.
        """
        measurement = self.measurement(calibration, snapshot)
        if measurement is None:
            return calibration
        values, H = measurement.values, measurement.jacobian
        C = calibration.covariance
        S = H @ C @ H.T + measurement.covariance
        distances = np.abs(values) / np.sqrt(np.diag(S))
        squared = float(values @ np.linalg.solve(S, values))
        agrees = bool(distances.max() < CONTRADICTED_SIGMAS and squared < CHI2[0.01][len(values)])
        updated = calibration
        if agrees:
            gain = np.asarray(np.linalg.solve(S, H @ C).T, dtype=float)
            updated = _updated(calibration, measurement, gain)
        axes = _axes_of_part(calibration, updated, measurement, distances)
        part = GroundResult(self.parent.source, self.child.source, agrees, axes)
        return updated.with_part("ground", part)

    def measurement(self, calibration: Calibration, snapshot: Any) -> Measurement | None:
        """Return the measurement, linearised at a result; None with too few data."""
        T = calibration.T_parent_child
        R = se3.rotation_of(T)
        offset_s = calibration.time_offset_s
        tracks = _at_same_times(self.parent, self.child, offset_s)
        if not len(tracks[0]):
            return None
        basis, axes = _axes_of(tracks[0].ups)
        streams = snapshot.streams
        differences = _differences(*tracks, T, basis)
        slopes = _slopes(*tracks, streams, R, basis)
        is_good = _are_inliers(differences)
        parts = _parts_of(streams[0], tracks[0].stamps_ns[is_good])
        if len(np.unique(parts)) < _PARTS / 3:
            return None
        means = _means(differences[is_good], parts)
        has_slope = self.parent.source != self.child.source
        if has_slope:
            values, covariance = _fit_beside_slope(means, _means(slopes[is_good], parts))
        else:
            values, covariance = _fit(means)
        variance_of_tilt = has_slope * _ROAD**2
        for track in tracks:
            variance_of_tilt += _TILTS[track.source] ** 2
        variances = [variance_of_tilt, variance_of_tilt, 2 * _HEIGHT_M**2]
        jacobian = np.zeros((3, 6))
        jacobian[:2, 3:] = basis[:, :2].T @ R
        jacobian[2, :3] = basis[:, 2] @ R
        count = len(values)
        covariance = covariance + np.diag(variances[:count])
        return Measurement(axes[:count], values, jacobian[:count], covariance)


def _at_same_times(
    parent: VerticalTrack, child: VerticalTrack, offset_s: float
) -> tuple[VerticalTrack, VerticalTrack]:
    """Return the rows of both tracks at common instants, at most an interval of the child apart.

    ``offset_s`` is added to the stamps of the child.
    """
    child = child[np.argsort(child.stamps_ns, kind="stable")]
    stamps_ns = child.stamps_ns + round(offset_s * 1e9)
    after = np.clip(np.searchsorted(stamps_ns, parent.stamps_ns), 1, len(stamps_ns) - 1)
    differences = np.abs(stamps_ns[[after - 1, after]] - parent.stamps_ns)
    nearest = after - (differences[0] <= differences[1])
    is_near = differences.min(axis=0) < median(np.diff(stamps_ns))
    return parent[is_near], child[nearest[is_near]]


def _axes_of(ups: FloatArray) -> tuple[FloatArray, tuple[str, str, str]]:
    """Return axes of the measurement, from verticals (N, 3) in the frame of the parent.

    Returns
    -------
    basis : (3, 3) array
        Columns: two horizontal directions and the vertical, along three axes of the parent as
        closely as possible, right-handed.
    axes : tuple of str
        These axes: two rotations and one translation.
    """
    up = ups.mean(axis=0)
    up /= np.linalg.norm(up)
    third = int(np.abs(up).argmax())
    first, second = (third + 1) % 3, (third + 2) % 3
    vertical = up * np.sign(up[third])
    horizontal = np.eye(3)[first] - vertical[first] * vertical
    horizontal /= np.linalg.norm(horizontal)
    basis = np.column_stack([horizontal, np.cross(vertical, horizontal), vertical])
    return basis, (ROTATIONS[first], ROTATIONS[second], TRANSLATIONS[third])


def _differences(
    parent: VerticalTrack, child: VerticalTrack, T: FloatArray, basis: FloatArray
) -> FloatArray:
    """Return differences (K, 2 or 3) of the verticals: tilts (rad), and heights (m) of the ground.

    A tilt is the rotation that turns the vertical of the child into that of the parent.
    """
    of_child = child.ups @ se3.rotation_of(T).T
    crosses = np.cross(of_child, parent.ups)
    sines = np.linalg.norm(crosses, axis=1)
    angles = np.arctan2(sines, np.einsum("ki,ki->k", of_child, parent.ups))
    ratios = np.divide(angles, sines, out=np.ones_like(sines), where=sines > 0.0)
    columns = ratios[:, None] * crosses @ basis[:, :2]
    if parent.heights_m is None or child.heights_m is None:
        return columns
    heights = child.heights_m - parent.heights_m - parent.ups @ se3.translation_of(T)
    sign = np.sign(basis[:, 2] @ parent.ups[0])
    return np.column_stack([columns, sign * heights])


def _slopes(
    parent: VerticalTrack,
    child: VerticalTrack,
    streams: tuple[Trajectory, Trajectory],
    R: FloatArray,
    basis: FloatArray,
) -> FloatArray:
    """Return derivatives (K, 2, 2) of the tilts with respect to the slope of the road.

    The slope is fixed in the world of the sensor that measures the ground.
    """
    if parent.source == "ground":
        track, stream = parent, streams[0]
        turned = np.eye(3)
    else:
        track, stream = child, streams[1]
        turned = -R
    rotations = se3.rotation_of(stream.at(track.stamps_ns, extrapolate=True))
    in_world = np.einsum("kij,kj->ki", rotations, track.ups)
    horizontal = _axes_of(in_world)[0][:, :2]
    in_parent = turned @ np.swapaxes(rotations, 1, 2) @ horizontal
    return np.asarray(basis[:, :2].T @ se3.skew(parent.ups) @ in_parent)


def _are_inliers(differences: FloatArray) -> BoolArray:
    """Return which instants (K,) are no outliers."""
    deviations = np.abs(differences - medians(differences.T))
    sigmas = medians(deviations.T) / MEDIAN_NORMAL
    return np.asarray((deviations <= CONTRADICTED_SIGMAS * sigmas).all(axis=1))


def _parts_of(stream: Trajectory, stamps_ns: IntArray) -> IntArray:
    """Return the part of the drive (K,) of each stamp; parts are equally long on the road."""
    steps_m = np.linalg.norm(np.diff(se3.translation_of(stream.poses), axis=0), axis=1)
    way_m = np.append(0.0, np.cumsum(steps_m))
    shares = np.interp(stamps_ns, stream.stamps_ns, way_m) / way_m[-1]
    return np.minimum((_PARTS * shares).astype(int), _PARTS - 1)


def _means(values: FloatArray, parts: IntArray) -> FloatArray:
    """Return means (B, ...) of values (K, ...) in each part that has any."""
    numbers, part_of_value = np.unique(parts, return_inverse=True)
    counts = np.bincount(part_of_value)
    sums = Blocks.gathered(values, part_of_value, len(numbers)).sums
    return np.asarray(sums / counts.reshape(-1, *[1] * (values.ndim - 1)))


def _fit(means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (M,) of parts (B, M), and its covariance from their scatter."""
    center = means.mean(axis=0)
    residuals = means - center
    count = len(means)
    covariance = residuals.T @ residuals / (count * (count - 1))
    return center, covariance * _inflation(residuals)


def _fit_beside_slope(means: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean tilt (2,) of parts (B, 2) beside the slope of the road, and its covariance.

    A prior limits the slope: in a drive of one heading, it cannot be distinguished from the mount.
    """
    count = len(means)
    rows = np.concatenate([np.tile(np.eye(2), (count, 1, 1)), slopes], axis=2).reshape(-1, 4)
    prior = np.diag([0.0, 0.0, _SLOPE**-2, _SLOPE**-2])
    variance = 0.0
    for _ in range(2):
        information = rows.T @ rows + variance * prior
        solution = np.linalg.lstsq(information, rows.T @ means.ravel(), rcond=None)[0]
        residuals = means - (rows @ solution).reshape(-1, 2)
        scatter = (residuals**2).sum() / (2 * count - 4)
        variance = scatter * _inflation(residuals)
    covariance = np.linalg.inv(rows.T @ rows / variance + prior)
    return solution[:2], covariance[:2, :2]


def _inflation(residuals: FloatArray) -> float:
    """Return the factor of the variance of a mean, because neighbouring parts are correlated.

    W. K. Newey, K. D. West, Econometrica 55, 1987, with one lag.
    """
    correlation = (residuals[1:] * residuals[:-1]).sum() / (residuals**2).sum()
    return 1.0 + 2.0 * max(float(correlation), 0.0)


def _updated(calibration: Calibration, measurement: Measurement, gain: FloatArray) -> Calibration:
    """Return the result with a measurement that is weighted by a gain (6, M)."""
    T = se3.retracted(calibration.T_parent_child, gain @ measurement.values)
    from_motion = np.eye(6) - gain @ measurement.jacobian
    allowance = from_motion @ calibration.covariance_allowance @ from_motion.T
    covariance = from_motion @ calibration.covariance_measured @ from_motion.T
    covariance += gain @ measurement.covariance @ gain.T
    sigmas = sigmas_in_parent(se3.rotation_of(T), covariance)
    totals = np.hypot(sigmas, sigmas_in_parent(se3.rotation_of(T), allowance))
    dofs = []
    for of_motion, motion_total, sigma, total in zip(
        calibration.observability_measured, calibration.sigmas, sigmas.tolist(), totals, strict=True
    ):
        dof = judged(of_motion.name, sigma)
        if dof.verdict is DofVerdict.UNOBSERVABLE and np.isfinite(of_motion.sigma):
            dof = of_motion  # an unknown direction that has turned slightly with the child
        if dof.verdict is not DofVerdict.UNOBSERVABLE and 2 * total**2 < motion_total**2:
            dof = replace(dof, verdict=DofVerdict.PRIOR)
        elif of_motion.verdict is DofVerdict.PRIOR:
            dof = replace(dof, verdict=of_motion.verdict)
        dofs.append(dof)
    updated = replace(
        calibration,
        T_parent_child=T,
        covariance_measured=covariance,
        covariance_allowance=allowance,
        observability_measured=tuple(dofs),
    )
    if updated.status is SolveStatus.UNOBSERVABLE and not updated.hidden:
        updated = replace(updated, status=SolveStatus.OK)
    return updated


def _axes_of_part(
    calibration: Calibration, updated: Calibration, measurement: Measurement, distances: FloatArray
) -> tuple[GroundAxis, ...]:
    """Return the axes of the measurement beside those of the motion."""
    motion = dict(zip(AXES, se3.xyz_rpy(calibration.T_parent_child).tolist(), strict=True))
    sigmas = dict(zip(AXES, calibration.sigmas.tolist(), strict=True))
    totals = dict(zip(AXES, updated.sigmas.tolist(), strict=True))
    own_sigmas = np.sqrt(np.diag(measurement.covariance))
    axes = []
    for row, name in enumerate(measurement.axes):
        axis = GroundAxis(
            name=name,
            motion=motion[name],
            motion_sigma=sigmas[name],
            ground=motion[name] + float(measurement.values[row]),
            ground_sigma=float(own_sigmas[row]),
            distance=float(distances[row]),
            is_from_ground=2 * totals[name] ** 2 < sigmas[name] ** 2,
        )
        axes.append(axis)
    return tuple(axes)
