"""Linear regression of the child's motion on the parent's, with columns for possible faults.

Model: two sensors on one rigid body move together. A and B are the motions of parent and child over
a span, both in the parent's axes (B rotated by X); a and b are their displacements:

    b - a - (R_A - I) t = columns,        Log(R_B R_A') = columns.

The columns are a small rotation of X, a scale, and one group per fault. One table has the products
of all columns, summed over blocks of time. A group is fitted by solving a part of the table, and
the jackknife over the blocks estimates the standard deviations.

Motions over some seconds reveal gains, scales by axis, and worlds that are turned or moving.
Motions over a second reveal delays d and smoothing c. They change a motion of angular frequency f
by the factor ``1 - i f d - f^2 c``: by -d times the velocity and c times the acceleration at both
ends. Velocities and accelerations are differences of poses around the ends, without the poses at
the ends: otherwise both sides would contain the same white noise.

Noise of a column makes its coefficient smaller. Lever arms and delays therefore have instrumental
variables: the same columns, computed from the other stream. Accumulating noise makes the stream of
a column look less smooth, never smoother. Columns of the child alone can therefore show that the
child is smoothed.
"""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import BLOCKS
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, solve
from hand_eye_calib.core.base.stats import median, robust_sigma, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs

# Shortest step (s) of the differences for velocities and accelerations; at least one interval.
_STEP_S = 0.05
# Largest deviation of stamps from regular steps (share of a step).
TOLERANCE = 0.3

# Residual, in standard deviations, whose weight is a quarter.
_TUNING = 3.0
# Rounds of robust weights.
_ROUNDS = 4

# Column of the base that a group replaces: scales by axis contain the scale.
_INSTEAD = {"axes_child": "scale", "axes_parent": "scale"}

_Columns: TypeAlias = Mapping[str, FloatArray]
_Where: TypeAlias = Mapping[str, list[int]]


class Regression:
    """Robust linear regression on named groups of columns.

    Parameters
    ----------
    rows : (K, 6, p + 1) array
        Columns of displacements (m) and rotations (rad), in order of time; the last column is the
        target.
    probes : (K, 6, p + 1) array
        Instrumental variables: residuals are made orthogonal to them. Equal to ``rows`` where no
        column without noise exists.
    units : (6, 1) array
        Standard deviations that the rows are divided by.
    where : mapping
        Indices of the columns of each group.
    *base : str
        Groups that are part of every fit.
    """

    def __init__(
        self, rows: FloatArray, probes: FloatArray, units: FloatArray, where: _Where, *base: str
    ) -> None:
        self._where = where
        self._base = base
        self._displaced = np.sqrt((rows[:, :3] ** 2).sum(axis=1).mean(axis=0))
        rows = rows / units
        probes = probes / units
        n_rows, size, n_columns = rows.shape
        flat = rows.reshape(-1, n_columns)
        known = flat[:, [*self._columns(), n_columns - 1]]
        weights = np.ones(n_rows)
        for _ in range(_ROUNDS):
            products = (known * np.repeat(weights, size)[:, None]).T @ known
            values = solve(products, range(len(products) - 1))
            left = (known[:, -1] - known[:, :-1] @ values).reshape(n_rows, size)
            lengths = np.sqrt((left**2).sum(axis=1))
            self._sigma = max(median(lengths) / np.sqrt(size), 1e-12)
            squared = (lengths / self._sigma) ** 2 / (size * _TUNING**2)
            weights = robust_weights("geman_mcclure", squared)
        self._weight = float(weights.sum())
        weighted = rows * weights[:, None, None]
        self._squares = flat.T @ weighted.reshape(flat.shape)
        self._blocks = Blocks.of_rows(weighted, BLOCKS, probes)

    def _columns(self, group: str = "", *beside: str) -> list[int]:
        """Return the columns that are fitted together with a group."""
        base = (name for name in self._base if name != _INSTEAD.get(group))
        return [column for name in (*base, *beside) for column in self._where[name]]

    def biases(self, group: str) -> FloatArray:
        """Return the bias (m,) that noise of the columns can cause in the values of a group.

        The noise is assumed to be as large as the noise of the rows.
        """
        at = self._where[group]
        return np.asarray(self._sigma**2 * self._weight / np.maximum(self._squares[at, at], 1e-300))

    def displaced(self, group: str) -> FloatArray:
        """Return the root mean square displacement (m,) that one unit of each value causes."""
        return np.asarray(self._displaced[self._where[group]])

    def share(self, group: str, *beside: str) -> float:
        """Return the share of the squared residuals that a group explains."""
        before = self._columns(group, *beside)
        costs = []
        for columns in (before, [*before, *self._where[group]]):
            x = np.append(-self._blocks.solve(columns), 1.0)
            at = [*columns, -1]
            costs.append(float(x @ self._squares[np.ix_(at, at)] @ x))
        return 1.0 - costs[1] / max(costs[0], 1e-300)

    def fit(self, group: str, *beside: str) -> tuple[FloatArray, FloatArray]:
        """Return the values (m,) of a group of m columns, and their standard deviations (m,).

        The base and the groups ``beside`` are fitted together with the group. The standard
        deviations are those of the jackknife over blocks.
        """
        before = self._columns(group, *beside)
        columns = [*before, *self._where[group]]
        # Without one block, and without two: errors may last longer than one block.
        covariances = [
            blocks.jackknife(columns) for blocks in (self._blocks, self._blocks.merged(BLOCKS // 2))
        ]
        variances = np.max([np.diag(covariance) for covariance in covariances], axis=0)
        return self._blocks.solve(columns)[len(before) :], np.sqrt(variances[len(before) :])


class _Stream:
    """Motions of a stream over a span, in the parent's axes.

    ``turned`` (3, 3) rotates the stream's axes to the parent's. Displacements are in the axes of
    the pose half-way: its errors are independent of the errors at the ends.
    """

    def __init__(self, poses: FloatArray, pairs: MotionPairs, turned: FloatArray) -> None:
        self._poses = poses
        self._turned = turned
        self.rows = pairs.i, (pairs.i + pairs.j) // 2, pairs.j
        start, middle, end = (poses[rows] for rows in self.rows)
        self.from_world = turned @ np.swapaxes(se3.rotation_of(middle), 1, 2)
        self.ends = self.from_world @ se3.rotation_of(start), self.from_world @ se3.rotation_of(end)
        self.chords = self.ends[1] - self.ends[0]
        self.rotations = (
            turned @ np.swapaxes(se3.rotation_of(start), 1, 2) @ se3.rotation_of(end) @ turned.T
        )
        self.displaced = se3.translation_of(end) - se3.translation_of(start)
        self.moved = se3.times(self.from_world, self.displaced)

    def back(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (N, 3) at the start minus those at the end, in the axes of the start."""
        start, _, end = (vectors[rows] for rows in self.rows)
        return start - se3.times(self.rotations, end)

    def derivatives(self, step: int, h: float) -> tuple[FloatArray, ...]:
        """Return derivatives (N, 3) of all poses, by differences over steps of ``h`` seconds.

        They are velocity and acceleration in the stream's world, and angular velocity and angular
        acceleration in the parent's axes.
        """
        p = se3.translation_of(self._poses)
        n = len(self._poses)
        rows = {k: np.clip(np.arange(n) + k * step, 0, n - 1) for k in (-2, -1, 1, 2)}
        turned = [
            se3.rotation_log(
                np.swapaxes(self._poses[rows[k], :3, :3], 1, 2) @ self._poses[rows[m], :3, :3]
            )
            @ self._turned.T
            for k, m in ((-1, 1), (-2, -1), (1, 2))
        ]
        return (
            (p[rows[1]] - p[rows[-1]]) / (2 * h),
            (p[rows[2]] - p[rows[1]] - p[rows[-1]] + p[rows[-2]]) / (3 * h**2),
            turned[0] / (2 * h),
            (turned[2] - turned[1]) / (3 * h**2),
        )


def response(
    pose_pairs: PosePairs,
    motions: MotionPairs,
    T_parent_child: FloatArray,
    moved_at_ns: int | None = None,
) -> tuple[Regression, FloatArray]:
    """Return the regression of motions over some seconds, and the principal axes of rotation.

    The axes are the columns of a (3, 3) array, in the parent sensor's frame.

    Notes
    -----
    Groups of columns:

    - ``turned_child``, ``turned_parent``, ``turned_both``: rotation vector between positions and
      orientations, in the stream's world; for both streams in the parent's world.
    - ``axes_child``, ``axes_parent``: factors, less 1, of the coordinates of the positions.
    - ``drift``: velocity and angular rate of the child's world.
    - ``gain``: factors, less 1, of the child's rotations about the principal axes.
    - ``moved``: change of lever arm and rotation of X after ``moved_at_ns``, if given.
    """
    parent = _Stream(pose_pairs.Ts_pw_p, motions, np.eye(3))
    child = _Stream(pose_pairs.Ts_cw_c, motions, se3.rotation_of(T_parent_child))
    # Displacements of each stream in its world, predicted from the other stream.
    arm = se3.times(parent.chords, se3.translation_of(T_parent_child))
    p_seen = se3.times(np.swapaxes(parent.from_world, 1, 2), child.moved - arm)
    c_seen = se3.times(np.swapaxes(child.from_world, 1, 2), parent.moved + arm)
    stamps_ns = pose_pairs.stamps_ns
    seconds = (stamps_ns[motions.j] - stamps_ns[motions.i]) * 1e-9
    drifted = child.from_world * seconds[:, None, None]
    middle = pose_pairs.Ts_cw_c[motions.i, :3, 3] + 0.5 * child.displaced
    middle = middle - middle.mean(axis=0)
    x = se3.rotation_log(parent.rotations)
    axes = np.linalg.eigh(x.T @ x)[1][:, ::-1]
    turned_child = -child.from_world @ se3.skew(child.displaced)
    turned_parent = parent.from_world @ se3.skew(parent.displaced)
    worlds = (np.swapaxes(child.from_world, 1, 2) @ parent.from_world).mean(axis=0)
    groups = {
        "turned_child": _rows(turned_child),
        "turned_parent": _rows(turned_parent),
        "turned_both": _rows(turned_parent + turned_child @ se3.nearest_rotation(worlds)),
        "axes_child": _rows(child.from_world * c_seen[:, None, :]),
        "axes_parent": _rows(-parent.from_world * p_seen[:, None, :]),
        "drift": np.concatenate(
            [_rows(drifted), _rows(-drifted @ se3.skew(middle), drifted)], axis=2
        ),
        "gain": _rows(np.zeros_like(drifted), (x @ axes)[:, None, :] * axes[None]),
    }
    if moved_at_ns is not None:
        after = (stamps_ns[motions.i] + stamps_ns[motions.j]) // 2 >= moved_at_ns
        of_x = [part for name, part in _of_mount(parent, child).items() if name != "scale"]
        groups["moved"] = after[:, None, None] * np.concatenate(of_x, axis=2)
    return _regression(parent, child, T_parent_child, groups, {}), axes


def delays(
    pose_pairs: PosePairs, motions: MotionPairs, T_parent_child: FloatArray
) -> Regression | None:
    """Return the regression of motions over about a second; None if too few poses are regular.

    Notes
    -----
    Groups of columns:

    - ``late_child``, ``late_parent``: delay (s) of the positions against the orientations of the
      stream. The instrumental variables are velocities of the other stream.
    - ``late_axes_child``, ``late_axes_parent``: the same delay by coordinate.
    - ``positions_child``, ``positions_parent``, ``orientations_child``, ``orientations_parent``:
      smoothing (s^2).
    """
    stamps_ns = pose_pairs.stamps_ns
    interval_s = median(np.diff(stamps_ns)) * 1e-9
    step = max(round(_STEP_S / interval_s), 1)
    h = step * interval_s
    follow = np.zeros(len(stamps_ns), dtype=bool)
    inner = np.arange(2 * step, len(stamps_ns) - 2 * step)
    around = np.array([-2, -1, 1, 2])
    elapsed_s = (stamps_ns[inner[:, None] + step * around] - stamps_ns[inner, None]) * 1e-9
    follow[inner] = (np.abs(elapsed_s - h * around) < TOLERANCE * h).all(axis=1)
    motions = motions[follow[motions.i] & follow[motions.j] & follow[(motions.i + motions.j) // 2]]
    if len(motions) < BLOCKS**2:
        return None
    X = T_parent_child
    Ts_parent = pose_pairs.Ts_pw_p
    Ts_child = pose_pairs.Ts_cw_c
    # Poses of each sensor, computed from the other stream.
    as_seen = Ts_child @ se3.inverse(X), Ts_parent @ X
    own, seen = (
        (_Stream(of_parent, motions, np.eye(3)), _Stream(of_child, motions, se3.rotation_of(X)))
        for of_parent, of_child in ((Ts_parent, Ts_child), as_seen)
    )
    groups, probes = (_of_filters(*each, se3.translation_of(X), step, h) for each in (own, seen))
    late = {name: probes[name] for name in ("late_child", "late_parent")}
    return _regression(*own, X, groups, late, "late")


def _of_filters(
    parent: _Stream, child: _Stream, arm: FloatArray, step: int, h: float
) -> dict[str, FloatArray]:
    """Return columns of delays and smoothing, and of a delay of all poses of the child ("late").

    ``arm`` (3,) is the lever arm to the child sensor, m.
    """
    groups = {}
    for name, sign, stream in (("child", -1.0, child), ("parent", 1.0, parent)):
        velocity, acceleration, rate, bend = stream.derivatives(step, h)
        start, middle, end = stream.rows
        faster = sign * (velocity[end] - velocity[start])
        bent = sign * (acceleration[start] - acceleration[end])
        late = se3.times(stream.from_world, faster)
        positions = se3.times(stream.from_world, bent)
        orientations = sign * se3.cross(bend[middle], stream.moved)
        if name == "child":
            groups["late"] = _rows(late + se3.cross(rate[middle], stream.moved), stream.back(rate))
        else:
            arms = [se3.cross(bend[rows], arm) for rows in (start, end)]
            orientations += se3.times(stream.ends[0], arms[0]) - se3.times(stream.ends[1], arms[1])
        groups[f"late_{name}"] = _rows(late)
        groups[f"late_axes_{name}"] = _rows(stream.from_world * faster[:, None, :])
        groups[f"positions_{name}"] = _rows(positions)
        groups[f"orientations_{name}"] = _rows(orientations, sign * stream.back(bend))
    return groups


def _of_mount(parent: _Stream, child: _Stream) -> dict[str, FloatArray]:
    """Return the columns of lever arm and rotation of X, and of the scale."""
    return {
        "lever": _rows(parent.chords),
        "rotation": _rows(se3.skew(child.moved), child.rotations - np.eye(3)),
        "scale": _rows(child.moved),
    }


def _rows(of_t: FloatArray, of_r: FloatArray | None = None) -> FloatArray:
    """Join columns of displacements and of rotations, (K, 3, m) or (K, 3) each, to (K, 6, m)."""
    both = np.concatenate([of_t, np.zeros_like(of_t) if of_r is None else of_r], axis=1)
    return both.reshape(len(of_t), 6, -1)


def _regression(
    parent: _Stream, child: _Stream, X: FloatArray, groups: _Columns, probes: _Columns, *base: str
) -> Regression:
    """Return the regression on groups of columns, and on the columns of X and the scale."""
    displaced = child.moved - parent.moved
    turned = se3.rotation_log(child.rotations @ np.swapaxes(parent.rotations, 1, 2))
    unexplained = displaced - se3.times(parent.chords, se3.translation_of(X))
    of_both = ((unexplained, 1e-7), (turned, 1e-8))
    sizes = [max(float(robust_sigma(v)), least) for v, least in of_both]
    units = np.repeat(sizes, 3)[:, None]
    of_mount = _of_mount(parent, child)
    columns = of_mount | dict(groups) | {"target": _rows(displaced, turned)}
    ends = np.cumsum([each.shape[2] for each in columns.values()]).tolist()
    starts = zip(columns, [0, *ends], ends, strict=False)
    where = {name: list(range(start, end)) for name, start, end in starts}
    rows = np.concatenate([*columns.values()], axis=2)
    probing = rows.copy()
    for name, each in (_of_mount(child, child) | dict(probes)).items():
        probing[:, :, where[name]] = each
    return Regression(rows, probing, units, where, *of_mount, *base)
