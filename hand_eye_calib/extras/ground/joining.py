"""Update a result of the motion with the vertical that both sensors have measured.

The extrinsic X has the rotation R and the translation t, from the child to the parent. Both sensors
measure the vertical (unit vectors n_p, n_c) and their height over the ground (h_p, h_c):

    n_p = R n_c,    n_p . t = h_c - h_p.

If one sensor measures the ground and the other sensor gravity, n_p and R n_c differ by the slope s
of the road. The slope changes with the heading, but an error of R does not. So s and the error of R
are estimated together. An update of a Kalman filter then combines this measurement with X.
Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with applications to tracking and
navigation*, 2001, section 5.2.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.covariance import judged
from hand_eye_calib.core.assessment.prior import halves_variance
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.base.stats import CHI2, MEDIAN_NORMAL, median, medians
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import sigmas_in_parent
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.rules import CONTRADICTED_SIGMAS
from hand_eye_calib.extras.ground.part import GroundAxis, GroundResult
from hand_eye_calib.extras.ground.tracks import VerticalTrack

# Number of equally long sections of the drive. A third of them must have data.
_N_SECTIONS = 24

# Prior standard deviation of the slope of a road (rad): half the slope of steep roads (10 %).
_SLOPE_SIGMA_RAD = 0.05

# Standard deviation of a constant error of the height (m) of one sensor, which no drive reveals. It
# is the root mean square on 80 simulated drives in five places, with the errors in data sheets of
# rotating lidars: 1 cm for ranges, 0.05 deg for elevations of beams.
_HEIGHT_SIGMA_M = 0.007
# Standard deviation of a constant error of the vertical (rad), by measured quantity. Ground: 0.02
# deg, root mean square on 26 further simulated drives. Gravity: the bias of 2 mg in data sheets of
# industrial accelerometers.
_TILT_SIGMAS_RAD = {"ground": float(np.radians(0.02)), "gravity": 0.002}
# Share of the bend of a road that remains in the vertical of the lane. Measured for the whole road:
# 0.3 to 0.5 on simulated streets with a crown of 2 %.
_BEND_SHARE = 0.5


class Measurement(NamedTuple):
    """Measurement of a correction xi of the extrinsic X: ``values = jacobian @ xi + noise``.

    The corrected extrinsic is ``X exp(xi)``, with xi = (rho, phi) in the axes of the child.

    Attributes
    ----------
    axes : tuple of str
        Axis of the parent nearest to each row: two rotations, and one translation if both sensors
        measure heights.
    values : (M,) array
        Measured minus predicted values (rad, m) at the linearisation point.
    jacobian : (M, 6) array
    covariance : (M, M) array
    """

    axes: tuple[str, ...]
    values: FloatArray
    jacobian: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class VerticalPair:
    """Verticals of both sensors at the same time, as a measurement of the extrinsic."""

    parent: VerticalTrack
    child: VerticalTrack

    def joined(self, calibration: Calibration, snapshot: Any) -> Calibration:
        """Update a result with the verticals if they agree with the motion.

        Parameters
        ----------
        calibration : Calibration
            Result of the motion alone.
        snapshot : Snapshot
            Streams of the result.

        Returns
        -------
        Calibration
            Result with a :class:`GroundResult`. It is unchanged if there are too few data.
        """
        measurement = self.measurement(calibration, snapshot)
        if measurement is None:
            return calibration
        values = measurement.values
        H = measurement.jacobian
        C = calibration.covariance
        S = H @ C @ H.T + measurement.covariance
        sigmas = np.sqrt(np.diag(S))
        distances = np.abs(values) / sigmas
        squared = float(values @ np.linalg.solve(S, values))
        limit = CHI2[0.01][len(values)]
        agrees = bool(distances.max() < CONTRADICTED_SIGMAS and squared < limit)
        updated = calibration
        if agrees:
            gain = np.asarray(np.linalg.solve(S, H @ C).T, dtype=float)
            updated = _updated(calibration, measurement, gain)
        axes = _ground_axes(calibration, updated, measurement, distances)
        part = GroundResult(self.parent.source, self.child.source, agrees, axes)
        return updated.with_part("ground", part)

    def measurement(
        self, calibration: Calibration, snapshot: Any
    ) -> Measurement | None:
        """Return the measurement, linearised at ``calibration``, or None if it is impossible.

        Both tracks must have common instants, and enough sections of the drive must have data.
        """
        T = calibration.T_parent_child
        R = se3.rotation_of(T)
        parent, child = _at_same_times(
            self.parent, self.child, calibration.time_offset_s
        )
        if not len(parent):
            return None
        basis, axes = _measured_axes(parent.ups)
        streams = snapshot.streams
        differences = _differences(parent, child, T, basis)
        slope_derivatives = _slope_derivatives(parent, child, streams, R, basis)
        is_inlier = _are_inliers(differences)
        sections = _sections_of(streams[0], parent.stamps_ns[is_inlier])
        if len(np.unique(sections)) < _N_SECTIONS / 3:
            return None
        means = _means(differences[is_inlier], sections)
        tilt_variance = 0.0
        # The slope of the road is part of a difference between the ground and the vertical. It
        # cancels between two tracks of the same kind.
        if parent.source != child.source:
            derivatives = _means(slope_derivatives[is_inlier], sections)
            values, covariance = _fit_with_slope(means, derivatives)
        else:
            values, covariance = _fit(means)
        for track in (parent, child):
            tilt_variance += _TILT_SIGMAS_RAD[track.source] ** 2
            # The bend moves with the vehicle, so it looks like a tilt of the mount.
            tilt_variance += (_BEND_SHARE * track.bend_rad) ** 2
        variances = [tilt_variance, tilt_variance, 2 * _HEIGHT_SIGMA_M**2]
        # Rows: rotation about two horizontal axes, translation along the vertical.
        jacobian = np.zeros((3, 6))
        jacobian[:2, 3:] = basis[:, :2].T @ R
        jacobian[2, :3] = basis[:, 2] @ R
        count = len(values)
        covariance = covariance + np.diag(variances[:count])
        return Measurement(axes[:count], values, jacobian[:count], covariance)


def _at_same_times(
    parent: VerticalTrack, child: VerticalTrack, offset_s: float
) -> tuple[VerticalTrack, VerticalTrack]:
    """Return the rows of parent and child at common instants, as two tracks of K rows.

    The instants in a row differ by less than the usual interval of the child. ``offset_s`` is added
    to the child's stamps.
    """
    order = np.argsort(child.stamps_ns, kind="stable")
    child = child[order]
    stamps_ns = child.stamps_ns + round(offset_s * 1e9)
    after = np.searchsorted(stamps_ns, parent.stamps_ns)
    after = np.clip(after, 1, len(stamps_ns) - 1)
    to_before_ns = np.abs(stamps_ns[after - 1] - parent.stamps_ns)
    to_after_ns = np.abs(stamps_ns[after] - parent.stamps_ns)
    is_before_nearer = to_before_ns <= to_after_ns
    nearest = after - is_before_nearer
    to_nearest_ns = np.minimum(to_before_ns, to_after_ns)
    usual_interval_ns = median(np.diff(stamps_ns))
    is_near = to_nearest_ns < usual_interval_ns
    near_rows = nearest[is_near]
    return parent[is_near], child[near_rows]


def _measured_axes(ups: FloatArray) -> tuple[FloatArray, tuple[str, str, str]]:
    """Return the axes of the measurement, from verticals (N, 3) in the frame of the parent.

    Returns
    -------
    basis : (3, 3) array
        Right-handed unit vectors as columns: two horizontal directions, then the vertical. Each
        vector is near to an axis of the parent.
    axes : tuple of str
        Names of these axes of the parent: two rotations and one translation.
    """
    up = ups.mean(axis=0)
    up /= np.linalg.norm(up)
    third = int(np.abs(up).argmax())
    first = (third + 1) % 3
    second = (third + 2) % 3
    vertical = up * np.sign(up[third])
    first_axis = np.eye(3)[first]
    horizontal = first_axis - vertical[first] * vertical
    horizontal /= np.linalg.norm(horizontal)
    other_horizontal = np.cross(vertical, horizontal)
    basis = np.column_stack([horizontal, other_horizontal, vertical])
    axes = (ROTATIONS[first], ROTATIONS[second], TRANSLATIONS[third])
    return basis, axes


def _differences(
    parent: VerticalTrack,
    child: VerticalTrack,
    T: FloatArray,
    basis: FloatArray,
) -> FloatArray:
    """Return differences (K, 2 or 3) between the parent and the child at each instant.

    The first two columns are tilts (rad) about the horizontal axes of the basis: the rotation from
    the vertical of the child (in the parent's frame) to the vertical of the parent. If both sensors
    measure heights, the third column is the error (m) of the translation along the vertical.
    """
    child_ups = child.ups @ se3.rotation_of(T).T
    # The cross product of unit vectors is along the rotation axis, and its length is the sine of
    # the angle. A rotation vector has the length of the angle.
    crosses = np.cross(child_ups, parent.ups)
    sines = np.linalg.norm(crosses, axis=1)
    cosines = np.einsum("ki,ki->k", child_ups, parent.ups)
    angles = np.arctan2(sines, cosines)
    angle_per_sine = np.divide(
        angles, sines, out=np.ones_like(sines), where=sines > 0.0
    )
    rotation_vectors = angle_per_sine[:, None] * crosses
    horizontal = basis[:, :2]
    tilts = rotation_vectors @ horizontal
    if parent.heights_m is None or child.heights_m is None:
        return tilts
    predicted_m = parent.ups @ se3.translation_of(T)
    errors_m = child.heights_m - parent.heights_m - predicted_m
    # If the nearest axis of the parent points down, the vertical of the basis points down.
    vertical = basis[:, 2]
    sign = np.sign(vertical @ parent.ups[0])
    return np.column_stack([tilts, sign * errors_m])


def _slope_derivatives(
    parent: VerticalTrack,
    child: VerticalTrack,
    streams: tuple[Trajectory, Trajectory],
    R: FloatArray,
    basis: FloatArray,
) -> FloatArray:
    """Return derivatives (K, 2, 2) of the two tilts with respect to the slope of the road.

    The slope has two components (rad), constant in the world of the sensor that measures the
    ground: changes of the normal of the ground along two horizontal directions.
    """
    if parent.source == "ground":
        track = parent
        stream = streams[0]
        to_parent = np.eye(3)
    else:
        track = child
        stream = streams[1]
        # Tilts are parent minus child, so the child's normal has a negative sign.
        to_parent = -R
    poses = stream.at(track.stamps_ns, extrapolate=True)
    rotations = se3.rotation_of(poses)
    ups_in_world = np.einsum("kij,kj->ki", rotations, track.ups)
    world_basis, _ = _measured_axes(ups_in_world)
    horizontal = world_basis[:, :2]
    to_sensor = np.swapaxes(rotations, 1, 2)
    in_parent = to_parent @ to_sensor @ horizontal
    tilt_axes = basis[:, :2].T
    return tilt_axes @ se3.skew(parent.ups) @ in_parent


def _are_inliers(differences: FloatArray) -> BoolArray:
    """Return a mask (K,) of the instants whose differences (K, M) are no outliers.

    The gate about the median is ``CONTRADICTED_SIGMAS`` standard deviations, which are estimated
    from the median deviation.
    """
    deviations = np.abs(differences - medians(differences.T))
    sigmas = medians(deviations.T) / MEDIAN_NORMAL
    is_near = deviations <= CONTRADICTED_SIGMAS * sigmas
    return np.asarray(is_near.all(axis=1))


def _sections_of(stream: Trajectory, stamps_ns: IntArray) -> IntArray:
    """Return the number of the section of the drive (K,) in which each stamp (K,) is."""
    steps = np.diff(se3.translation_of(stream.poses), axis=0)
    steps_m = np.linalg.norm(steps, axis=1)
    driven_m = np.append(0.0, np.cumsum(steps_m))
    places_m = np.interp(stamps_ns, stream.stamps_ns, driven_m)
    shares = places_m / driven_m[-1]
    sections = (_N_SECTIONS * shares).astype(int)
    return np.minimum(sections, _N_SECTIONS - 1)


def _means(values: FloatArray, sections: IntArray) -> FloatArray:
    """Return the mean (B, ...) of values (K, ...) in each of the B sections that have values."""
    numbers, row_of_value = np.unique(sections, return_inverse=True)
    counts = np.bincount(row_of_value)
    sums = Blocks.gathered(values, row_of_value, len(numbers)).sums
    n_further_axes = values.ndim - 1
    columns = counts.reshape(-1, *[1] * n_further_axes)
    return sums / columns


def _fit(means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (M,) over sections (B, M), and the covariance (M, M) of this mean.

    The covariance is computed from the scatter of the sections.
    """
    center = means.mean(axis=0)
    residuals = means - center
    count = len(means)
    n_products = count * (count - 1)
    covariance = residuals.T @ residuals / n_products
    factor = _correlation_factor(residuals)
    return center, covariance * factor


def _fit_with_slope(
    means: FloatArray, slope_derivatives: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Estimate the tilt of the mount together with the slope of the road.

    At constant heading, the slope cannot be distinguished from a tilt of the mount. A prior then
    limits the slope.

    Parameters
    ----------
    means : (B, 2) array
        Mean tilts of the sections, rad.
    slope_derivatives : (B, 2, 2) array

    Returns
    -------
    tilt : (2,) array
    covariance : (2, 2) array
    """
    count = len(means)
    # The unknowns are two tilts of the mount, equal in all sections, and two slopes.
    of_mount = np.tile(np.eye(2), (count, 1, 1))
    derivatives = np.concatenate([of_mount, slope_derivatives], axis=2)
    rows = derivatives.reshape(-1, 4)
    products = rows.T @ rows
    slope_information = _SLOPE_SIGMA_RAD**-2
    prior = np.diag([0.0, 0.0, slope_information, slope_information])
    # The first solve is without the prior. Its residuals determine the variance, with which the
    # prior is weighted.
    variance = 0.0
    for _ in range(2):
        information = products + variance * prior
        score = rows.T @ means.ravel()
        solution, *_ = np.linalg.lstsq(information, score, rcond=None)
        predicted = rows @ solution
        residuals = means - predicted.reshape(-1, 2)
        degrees_of_freedom = 2 * count - 4
        scatter = (residuals**2).sum() / degrees_of_freedom
        variance = scatter * _correlation_factor(residuals)
    covariance = np.linalg.inv(products / variance + prior)
    return solution[:2], covariance[:2, :2]


def _correlation_factor(residuals: FloatArray) -> float:
    """Return the factor by which correlation of adjacent sections enlarges a variance.

    W. K. Newey, K. D. West, Econometrica 55, 1987, with one lag.
    """
    products = residuals[1:] * residuals[:-1]
    squares = residuals**2
    correlation = float(products.sum() / squares.sum())
    return 1.0 + 2.0 * max(correlation, 0.0)


def _updated(
    calibration: Calibration, measurement: Measurement, gain: FloatArray
) -> Calibration:
    """Update a result by a Kalman gain (6, M).

    The new covariance is the Joseph form ``(I - K H) C (I - K H)' + K V K'``.
    """
    correction = gain @ measurement.values
    T = se3.retracted(calibration.T_parent_child, correction)
    from_motion = np.eye(6) - gain @ measurement.jacobian
    allowance = from_motion @ calibration.covariance_allowance @ from_motion.T
    covariance = from_motion @ calibration.covariance_measured @ from_motion.T
    covariance += gain @ measurement.covariance @ gain.T
    R = se3.rotation_of(T)
    sigmas = sigmas_in_parent(R, covariance)
    allowance_sigmas = sigmas_in_parent(R, allowance)
    totals = np.hypot(sigmas, allowance_sigmas)
    is_from_ground = halves_variance(totals, calibration.sigmas)
    dofs = []
    for of_motion, sigma, has_prior in zip(
        calibration.observability_measured,
        sigmas.tolist(),
        is_from_ground,
        strict=True,
    ):
        dof = judged(of_motion.name, sigma)
        is_unobservable = dof.verdict is DofVerdict.UNOBSERVABLE
        if is_unobservable and np.isfinite(of_motion.sigma):
            # The rotation of the child has slightly changed an unobservable direction.
            dof = of_motion
        is_by_ground = has_prior and dof.verdict is not DofVerdict.UNOBSERVABLE
        if is_by_ground or of_motion.verdict is DofVerdict.PRIOR:
            dof = replace(dof, verdict=DofVerdict.PRIOR)
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


def _ground_axes(
    calibration: Calibration,
    updated: Calibration,
    measurement: Measurement,
    distances: FloatArray,
) -> tuple[GroundAxis, ...]:
    """Return each measured axis by the motion alone and by the ground alone.

    ``distances`` (M,) are the differences of both values in joint standard deviations.
    """
    values = se3.xyz_rpy(calibration.T_parent_child).tolist()
    is_from_ground = halves_variance(updated.sigmas, calibration.sigmas)
    ground_sigmas = np.sqrt(np.diag(measurement.covariance))
    axes = []
    for row, name in enumerate(measurement.axes):
        column = AXES.index(name)
        from_motion = values[column]
        axis = GroundAxis(
            name=name,
            motion=from_motion,
            motion_sigma=float(calibration.sigmas[column]),
            ground=from_motion + float(measurement.values[row]),
            ground_sigma=float(ground_sigmas[row]),
            distance=float(distances[row]),
            is_from_ground=bool(is_from_ground[column]),
        )
        axes.append(axis)
    return tuple(axes)
