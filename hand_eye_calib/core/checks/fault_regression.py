"""Regression of the motion between two streams on possible faults.

Two sensors move together on one rigid body. A and B are the motions of parent and child over a span
of time, both in the parent's axes (B is rotated by R_X). a and b are their displacements, and t is
the lever arm. A fault k of size f_k changes the motion by ``c_k f_k``:

    b - a = (R_A - I) t + sum_k c_k f_k + noise,        Log(R_B R_A') = sum_k c_k f_k + noise.

Words of this module:

- A *regressor* c_k is the displacement (m) and the rotation (rad) that a fault of size 1 causes.
- The *coefficient* of a regressor is the estimated size of the fault.
- A *group* is the regressors of one fault, such as its three axes.
- The *base* is the set of groups in every fit: the lever arm, a small rotation of X, the scale.

Motions over some seconds reveal gains, scales by axis, and worlds that are turned or moving.
Motions over a second reveal delays d and smoothing c. They change a motion of angular frequency f
by the factor ``1 - i f d - f^2 c``: by -d times the velocity and c times the acceleration at both
ends. Velocities and accelerations are differences of the poses around the ends, without the poses
at the ends. Otherwise residuals and regressors would contain the same white noise.

Regressors are computed from measured poses, so they have noise. This noise biases coefficients
towards zero (W. Greene, *Econometric Analysis*, 2012, chapter 8). Lever arms and delays have
*instruments* (instrumental variables) without this bias: the same regressors, computed from the
other stream. Noise that accumulates makes a stream look less smooth, never smoother. So regressors
of the child alone can reveal that the child is smoothed.

The jackknife over blocks of time estimates the standard deviations.
"""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import BLOCKS
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks, solve
from hand_eye_calib.core.base.stats import median, robust_sigma, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.differences import (
    Stencil,
    path_derivatives,
    rotations_around,
    stencil,
)
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs

# Shortest step (s) of the differences for velocities and accelerations; at least one interval.
_MIN_STEP_S = 0.05
# Stamps are regular if they deviate from multiples of a step by less than this share of a step.
_MAX_STAMP_ERROR = 0.3

# A motion whose residual has this length, in standard deviations, gets a quarter of the full
# weight.
_QUARTER_WEIGHT_SIGMAS = 3.0
# Number of rounds in which the robust weights are computed.
ROUNDS = 4

# Smallest standard deviation of displacements (m), for streams without noise.
_MIN_UNIT_M = 1e-7
# Smallest standard deviation of rotations (rad), for streams without noise.
_MIN_UNIT_RAD = 1e-8

# Group of the base that is left out if the key is fitted: scales by axis contain the scale.
_REPLACED = {"axes_child": "scale", "axes_parent": "scale"}

# Regressors (K, 6, n) of K motions, by the name of their group of n regressors.
_Groups: TypeAlias = Mapping[str, FloatArray]


class Regression:
    """Robust linear regression of motions on groups of regressors.

    Parameters
    ----------
    rows : (K, 6, p + 1) array
        The p regressors of K motions in order of time, displacements (m) before rotations (rad).
        The last column is the observed difference between both streams.
    instruments : (K, 6, p + 1) array
        Instruments of the columns. Regressors without an instrument are their own.
    units : (6, 1) array
        Standard deviations of the noise, in m and rad. The rows were divided by them.
    columns : mapping
        Columns of the regressors of each group.
    base : sequence of str
        Groups that are part of every fit.
    """

    def __init__(
        self,
        rows: FloatArray,
        instruments: FloatArray,
        units: FloatArray,
        columns: Mapping[str, list[int]],
        base: list[str],
    ) -> None:
        self._columns = columns
        self._base = base
        self._displacements_m = np.sqrt(
            (rows[:, :3] ** 2).sum(axis=1).mean(axis=0)
        )
        rows = rows / units
        n_motions, _, n_columns = rows.shape
        flat = rows.reshape(-1, n_columns)
        of_base = flat[:, [*self._columns_of(base), n_columns - 1]]
        self._sigma, weights = _robust_fit(of_base, n_motions)
        self._total_weight = float(weights.sum())
        weighted = rows * weights[:, None, None]
        # Products of all columns, summed with the weights, (p + 1, p + 1).
        self._products = flat.T @ weighted.reshape(flat.shape)
        self._blocks = Blocks.of_rows(weighted, BLOCKS, instruments / units)

    def _columns_of(self, groups: list[str]) -> list[int]:
        """Return the columns of groups, in the order of the groups."""
        return [column for name in groups for column in self._columns[name]]

    def _columns_beside(
        self, group: str, nuisances: tuple[str, ...]
    ) -> list[int]:
        """Return the columns of the base and the nuisances, which are fitted with a group."""
        base = [name for name in self._base if name != _REPLACED.get(group)]
        return self._columns_of([*base, *nuisances])

    def biases(self, group: str) -> FloatArray:
        """Return the largest bias of a group's n coefficients by noise of the regressors, (n,).

        The noise of the regressors is assumed to be as large as the noise of the residuals.
        """
        columns = self._columns[group]
        squares = np.maximum(self._products[columns, columns], 1e-300)
        return self._sigma**2 * self._total_weight / squares

    def displacements_m(self, group: str) -> FloatArray:
        """Return the root mean square displacements (n,) by each fault of a group for size 1."""
        return self._displacements_m[self._columns[group]]

    def response(self, group: str) -> FloatArray:
        """Return the changes (6, n) of X by n faults of size 1 that the fit omits.

        A change has the lever arm (m) and a rotation vector (rad), in the parent's axes.
        """
        of_extrinsic = self._columns_of(["lever", "rotation"])
        information = self._products[np.ix_(of_extrinsic, of_extrinsic)]
        coupling = self._products[np.ix_(of_extrinsic, self._columns[group])]
        return np.asarray(
            np.linalg.pinv(information, hermitian=True) @ coupling
        )

    def explained_share(self, group: str, *nuisances: str) -> float:
        """Return the share (0 to 1) of the squared residuals that a group explains.

        The base and the groups ``nuisances`` are part of both fits: without and with the group.
        """
        beside = self._columns_beside(group, nuisances)
        costs = []
        for columns in (beside, [*beside, *self._columns[group]]):
            x = np.append(-self._blocks.solve(columns), 1.0)
            used = [*columns, -1]
            costs.append(float(x @ self._products[np.ix_(used, used)] @ x))
        return 1.0 - costs[1] / max(costs[0], 1e-300)

    def fit(self, group: str, *nuisances: str) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients (n,) of a group of n regressors, and their sigmas (n,).

        The base and the groups ``nuisances`` are fitted together with the group.
        """
        beside = self._columns_beside(group, nuisances)
        columns = [*beside, *self._columns[group]]
        # Use the larger jackknife variance of long and short blocks: errors may be correlated for
        # longer than a short block.
        variances = np.maximum(
            np.diag(self._blocks.jackknife(columns)),
            np.diag(self._blocks.merged(BLOCKS // 2).jackknife(columns)),
        )
        coefficients = self._blocks.solve(columns)
        return coefficients[len(beside) :], np.sqrt(variances[len(beside) :])


def _robust_fit(
    of_base: FloatArray, n_motions: int
) -> tuple[float, FloatArray]:
    """Fit the base to K motions robustly; return the noise, and the weights (K,) of the motions.

    The rows of ``of_base`` (6 K, b + 1) have the b regressors of the base, then the observed
    difference, in units of the noise. The returned noise is in the same units.
    """
    size = len(of_base) // n_motions
    sigma = 0.0
    weights = np.ones(n_motions)
    for _ in range(ROUNDS):
        products = (of_base * np.repeat(weights, size)[:, None]).T @ of_base
        coefficients = solve(products, range(len(products) - 1))
        residuals = of_base[:, -1] - of_base[:, :-1] @ coefficients
        squares = residuals.reshape(n_motions, size) ** 2
        lengths = np.sqrt(squares.sum(axis=1))
        sigma = max(median(lengths) / np.sqrt(size), 1e-12)
        squared = (lengths / sigma) ** 2 / (size * _QUARTER_WEIGHT_SIGMAS**2)
        weights = robust_weights("geman_mcclure", squared)
    return sigma, weights


class _Stream:
    """Motions of a stream over a span, in the parent's axes.

    Parameters
    ----------
    poses : (N, 4, 4) array
    pairs : MotionPairs
        First and last row of each of K motions.
    R_parent_sensor : (3, 3) array
        Rotation from the stream's sensor to the parent.

    Attributes
    ----------
    rows : tuple of three (K,) arrays
        Rows of the start, the middle and the end of each motion.
    from_world : (K, 3, 3) array
        Rotation from the stream's world to the parent's axes at the middle. Errors of the middle
        pose are independent of the errors at both ends.
    R_start, R_end, chords : (K, 3, 3) arrays
        Orientations at both ends in the axes at the middle, and their difference.
    rotations : (K, 3, 3) array
        Rotations from start to end, in the axes at the start.
    displacements_in_world, displacements : (K, 3) arrays
        Displacements from start to end (m): in the stream's world, and in the axes at the middle.
    """

    def __init__(
        self, poses: FloatArray, pairs: MotionPairs, R_parent_sensor: FloatArray
    ) -> None:
        self._poses = poses
        self._R_parent_sensor = R_parent_sensor
        self.rows = pairs.i, (pairs.i + pairs.j) // 2, pairs.j
        start, middle, end = (poses[rows] for rows in self.rows)
        self.from_world = R_parent_sensor @ np.swapaxes(
            se3.rotation_of(middle), 1, 2
        )
        self.R_start = self.from_world @ se3.rotation_of(start)
        self.R_end = self.from_world @ se3.rotation_of(end)
        self.chords = self.R_end - self.R_start
        to_start = R_parent_sensor @ np.swapaxes(se3.rotation_of(start), 1, 2)
        self.rotations = to_start @ se3.rotation_of(end) @ R_parent_sensor.T
        start_positions = se3.translation_of(start)
        end_positions = se3.translation_of(end)
        self.displacements_in_world = end_positions - start_positions
        self.displacements = se3.times(
            self.from_world, self.displacements_in_world
        )

    def start_minus_end(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (N, 3) at the start minus vectors at the end, in the axes at the start.

        The vectors at a pose are in the parent's axes at that pose.
        """
        start, _, end = self.rows
        return vectors[start] - se3.times(self.rotations, vectors[end])

    def angular_derivatives(
        self, around: Stencil, step_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return angular rates and angular accelerations (N, 3) of all poses, in parent's axes."""
        turns = rotations_around(se3.rotation_of(self._poses), around)
        turn, turn_before, turn_after = (
            vectors @ self._R_parent_sensor.T for vectors in turns
        )
        return turn / (2 * step_s), (turn_after - turn_before) / (3 * step_s**2)

    def derivatives(
        self, around: Stencil, step_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return velocities and accelerations (N, 3) of all poses, in the stream's world."""
        return path_derivatives(se3.translation_of(self._poses), around, step_s)


def _drift_regressors(
    pose_pairs: PosePairs, motions: MotionPairs, child: _Stream
) -> FloatArray:
    """Return the regressors of velocity (m/s) and angular rate (rad/s) of the child's world."""
    stamps_ns = pose_pairs.stamps_ns
    durations_s = (stamps_ns[motions.j] - stamps_ns[motions.i]) * 1e-9
    drifted = child.from_world * durations_s[:, None, None]
    start_positions = pose_pairs.Ts_cw_c[motions.i, :3, 3]
    middle = start_positions + 0.5 * child.displacements_in_world
    middle = middle - middle.mean(axis=0)
    translating = _regressors(drifted)
    rotating = _regressors(-drifted @ se3.skew(middle), drifted)
    return np.concatenate([translating, rotating], axis=2)


def motion_regression(
    pose_pairs: PosePairs,
    motions: MotionPairs,
    T_parent_child: FloatArray,
    moved_at_ns: int | None = None,
) -> tuple[Regression, FloatArray]:
    """Return the regression of motions over some seconds, and the principal axes of rotation.

    The axes are the columns of a (3, 3) array in the parent sensor's frame, the axis with the most
    rotation first.

    Notes
    -----
    Groups of regressors:

    - ``turned_child``, ``turned_parent``, ``turned_both``: rotation vector (rad) between positions
      and orientations, in the stream's world; for both streams in the parent's world.
    - ``axes_child``, ``axes_parent``: scale, less 1, of each coordinate of the positions.
    - ``drift``: velocity (m/s) and angular rate (rad/s) of the child's world.
    - ``gain``: factors, less 1, of the child's rotations about the principal axes.
    - ``moved``: change of lever arm and rotation of X after ``moved_at_ns``, if given.
    """
    parent = _Stream(pose_pairs.Ts_pw_p, motions, np.eye(3))
    child = _Stream(
        pose_pairs.Ts_cw_c, motions, se3.rotation_of(T_parent_child)
    )
    # Displacements of each stream in its own world, predicted from the motion of the other stream.
    arm = se3.times(parent.chords, se3.translation_of(T_parent_child))
    parent_to_world = np.swapaxes(parent.from_world, 1, 2)
    child_to_world = np.swapaxes(child.from_world, 1, 2)
    parent_predicted = se3.times(parent_to_world, child.displacements - arm)
    child_predicted = se3.times(child_to_world, parent.displacements + arm)
    rotations = se3.rotation_log(parent.rotations)
    axes = np.linalg.eigh(rotations.T @ rotations)[1][:, ::-1]
    turned_child = -child.from_world @ se3.skew(child.displacements_in_world)
    turned_parent = parent.from_world @ se3.skew(parent.displacements_in_world)
    between_worlds = child_to_world @ parent.from_world
    R_cw_pw = se3.nearest_rotation(between_worlds.mean(axis=0))
    axes_child = child.from_world * child_predicted[:, None, :]
    axes_parent = -parent.from_world * parent_predicted[:, None, :]
    groups = {
        "turned_child": _regressors(turned_child),
        "turned_parent": _regressors(turned_parent),
        "turned_both": _regressors(turned_parent + turned_child @ R_cw_pw),
        "axes_child": _regressors(axes_child),
        "axes_parent": _regressors(axes_parent),
        "drift": _drift_regressors(pose_pairs, motions, child),
        "gain": _regressors(
            np.zeros_like(child.from_world),
            (rotations @ axes)[:, None, :] * axes[None],
        ),
    }
    if moved_at_ns is not None:
        stamps_ns = pose_pairs.stamps_ns
        middle_ns = (stamps_ns[motions.i] + stamps_ns[motions.j]) // 2
        is_after = middle_ns >= moved_at_ns
        base = _base_groups(parent, child)
        of_extrinsic = np.concatenate([base["lever"], base["rotation"]], axis=2)
        groups["moved"] = is_after[:, None, None] * of_extrinsic
    return _regression(parent, child, T_parent_child, groups, {}), axes


def delay_regression(
    pose_pairs: PosePairs, motions: MotionPairs, T_parent_child: FloatArray
) -> Regression | None:
    """Return the regression of motions over one second; None if too few stamps are regular.

    Notes
    -----
    Groups of regressors:

    - ``late_child``, ``late_parent``: delay (s) of the positions after the orientations of the
      stream. Their instruments are velocities of the other stream.
    - ``late_axes_child``, ``late_axes_parent``: the same delay by coordinate.
    - ``positions_child``, ``positions_parent``, ``orientations_child``, ``orientations_parent``:
      smoothing c (s^2).
    """
    stamps_ns = pose_pairs.stamps_ns
    interval_s = median(np.diff(stamps_ns)) * 1e-9
    step = max(round(_MIN_STEP_S / interval_s), 1)
    step_s = step * interval_s
    is_regular = _are_regular(stamps_ns, step, step_s)
    middles = (motions.i + motions.j) // 2
    has_regular_ends = is_regular[motions.i] & is_regular[motions.j]
    motions = motions[has_regular_ends & is_regular[middles]]
    if len(motions) < BLOCKS**2:
        return None
    X = T_parent_child
    R_X = se3.rotation_of(X)
    lever_arm = se3.translation_of(X)
    around = stencil(np.asarray(stamps_ns * 1e-9, dtype=float), step)
    Ts_parent = pose_pairs.Ts_pw_p
    Ts_child = pose_pairs.Ts_cw_c
    parent = _Stream(Ts_parent, motions, np.eye(3))
    child = _Stream(Ts_child, motions, R_X)
    groups = _filter_groups(parent, child, lever_arm, around, step_s)
    # The same regressors, from poses of each sensor that are predicted from the other sensor.
    parent_of_child = _Stream(Ts_child @ se3.inverse(X), motions, np.eye(3))
    child_of_parent = _Stream(Ts_parent @ X, motions, R_X)
    from_other = _filter_groups(
        parent_of_child, child_of_parent, lever_arm, around, step_s
    )
    instruments = {
        name: from_other[name] for name in ("late_child", "late_parent")
    }
    return _regression(parent, child, X, groups, instruments, "late")


def _are_regular(stamps_ns: IntArray, step: int, step_s: float) -> BoolArray:
    """Return which poses (N,) have the four stamps around them at multiples of a step.

    A step has ``step`` poses and lasts ``step_s`` seconds. Poses at the ends are not regular.
    """
    is_regular = np.zeros(len(stamps_ns), dtype=bool)
    inner = np.arange(2 * step, len(stamps_ns) - 2 * step)
    multiples = np.array([-2, -1, 1, 2])
    around_ns = stamps_ns[inner[:, None] + step * multiples]
    elapsed_s = (around_ns - stamps_ns[inner, None]) * 1e-9
    errors_s = np.abs(elapsed_s - step_s * multiples)
    is_regular[inner] = (errors_s < _MAX_STAMP_ERROR * step_s).all(axis=1)
    return is_regular


def _filter_groups(
    parent: _Stream,
    child: _Stream,
    lever_arm: FloatArray,
    around: Stencil,
    step_s: float,
) -> dict[str, FloatArray]:
    """Return the groups of delays and smoothing, and "late": a delay of whole poses of the child.

    ``lever_arm`` (3,) is the lever arm of X, m. ``around`` is the stencil of the differences, and
    ``step_s`` (s) its step.
    """
    groups = {}
    for name, sign, stream in (("child", -1.0, child), ("parent", 1.0, parent)):
        velocity, acceleration = stream.derivatives(around, step_s)
        rate, angular_acceleration = stream.angular_derivatives(around, step_s)
        start, middle, end = stream.rows
        velocity_change = sign * (velocity[end] - velocity[start])
        acceleration_change = sign * (acceleration[start] - acceleration[end])
        late = se3.times(stream.from_world, velocity_change)
        positions = se3.times(stream.from_world, acceleration_change)
        # Smoothing changes the orientation of the middle pose, which rotates the displacement.
        orientations = sign * se3.cross(
            angular_acceleration[middle], stream.displacements
        )
        if name == "child":
            displaced = late + se3.cross(rate[middle], stream.displacements)
            groups["late"] = _regressors(
                displaced, stream.start_minus_end(rate)
            )
        else:
            # Smoothing also changes the parent's orientations at both ends, which rotate the lever
            # arm.
            at_start = se3.cross(angular_acceleration[start], lever_arm)
            at_end = se3.cross(angular_acceleration[end], lever_arm)
            orientations += se3.times(stream.R_start, at_start) - se3.times(
                stream.R_end, at_end
            )
        turned = sign * stream.start_minus_end(angular_acceleration)
        groups[f"late_{name}"] = _regressors(late)
        groups[f"late_axes_{name}"] = _regressors(
            stream.from_world * velocity_change[:, None, :]
        )
        groups[f"positions_{name}"] = _regressors(positions)
        groups[f"orientations_{name}"] = _regressors(orientations, turned)
    return groups


def noise_units(displacements: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return the standard deviations (6,) of displacements (K, 3) and rotations (K, 3)."""
    unit_m = max(float(robust_sigma(displacements)), _MIN_UNIT_M)
    unit_rad = max(float(robust_sigma(rotations)), _MIN_UNIT_RAD)
    return np.repeat([unit_m, unit_rad], 3)


def _base_groups(parent: _Stream, child: _Stream) -> dict[str, FloatArray]:
    """Return the groups of the base: lever arm (m), small rotation of X (rad), and scale."""
    return {
        "lever": _regressors(parent.chords),
        "rotation": _regressors(
            se3.skew(child.displacements), child.rotations - np.eye(3)
        ),
        "scale": _regressors(child.displacements),
    }


def _regressors(
    of_displacement: FloatArray, of_rotation: FloatArray | None = None
) -> FloatArray:
    """Join regressors of displacements and of rotations into one array (K, 6, n).

    Each argument is (K, 3, n), or (K, 3) for a single regressor. A fault that causes no rotations
    has displacements only.
    """
    if of_rotation is None:
        of_rotation = np.zeros_like(of_displacement)
    joined = np.concatenate([of_displacement, of_rotation], axis=1)
    return joined.reshape(len(of_displacement), 6, -1)


def _regression(
    parent: _Stream,
    child: _Stream,
    X: FloatArray,
    groups: _Groups,
    instruments: _Groups,
    *also_in_base: str,
) -> Regression:
    """Return the regression on groups of faults and on the base.

    The lever arm has instruments from the child's orientations; ``instruments`` are for the other
    groups. ``also_in_base`` names groups that become part of the base.
    """
    displaced = child.displacements - parent.displacements
    turned = se3.rotation_log(
        child.rotations @ np.swapaxes(parent.rotations, 1, 2)
    )
    residuals_m = displaced - se3.times(parent.chords, se3.translation_of(X))
    units = noise_units(residuals_m, turned)[:, None]
    base = _base_groups(parent, child)
    columns: dict[str, list[int]] = {}
    n_columns = 0
    all_groups = base | dict(groups)
    for name, regressors in all_groups.items():
        columns[name] = list(range(n_columns, n_columns + regressors.shape[2]))
        n_columns += regressors.shape[2]
    rows = np.concatenate(
        [*all_groups.values(), _regressors(displaced, turned)], axis=2
    )
    instrument_rows = rows.copy()
    for name, regressors in (
        _base_groups(child, child) | dict(instruments)
    ).items():
        instrument_rows[:, :, columns[name]] = regressors
    return Regression(
        rows, instrument_rows, units, columns, [*base, *also_in_base]
    )
