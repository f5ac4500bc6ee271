"""How the child's motion follows the parent's, beyond an extrinsic and a scale: one linear
regression, with a column for each thing that may be wrong.

Two sensors on one rigid body feel the same motion at the same time. With motions A, B of parent and
child over a span, in the parent's axes (B turned by X), and chords a, b,

    b - a - (R_A - I) t = ...,        Log(R_B R_A') = ...

where the dots are columns: a small rotation of X, a scale, and one group of columns per fault. All
groups are in one table of products, summed over blocks of time: to fit a group is to solve a small
part of it, and the jackknife over the blocks gives standard deviations. Motions over some seconds
show gains, scales by axis, worlds that are turned or that move; those over a second show delays and
smoothing, which change a motion of angular frequency f by ``1 - i f d - f^2 c``: -d times the
velocity and c times the acceleration at both ends. These come from poses around the ends, not from
those themselves: white noise has no part in both sides. Noise that accumulates makes the stream
that a column comes from look less smooth than it is, never smoother. So columns of the child show
that the child is smoothed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs, PosePairs
from hand_eye_calib.stats import median, robust_sigma

# Step (s) of the differences that velocities and accelerations come from; an interval of the poses
# if that is longer. Stamps may be off by this share of a step.
_STEP_S, _TOLERANCE = 0.1, 0.3
_MIN_MOTIONS, _BLOCKS = 10, 10

# Geman-McClure: residuals of about this many standard deviations have half the weight.
_TUNING, _ROUNDS = 3.0, 4


@dataclass(frozen=True)
class Fitted:
    """What a group of m columns is fitted with: values and standard deviations (m,), by the
    jackknife over blocks of time; and the share of the squared residuals that the group takes away.
    """

    values: FloatArray
    sigmas: FloatArray
    share: float


class Regression:
    """Robust linear regression of rows (K, r, p + 1), in standard deviations, the values last, on
    groups of the p columns: by name, where they are; those of ``base`` in every fit. Rows are in
    order of time.
    """

    def __init__(
        self, rows: FloatArray, where: Mapping[str, list[int]], base: Sequence[str], noise: float
    ) -> None:
        self._where, self._base = where, list(base)
        n_rows, size, n_columns = rows.shape
        known = rows.reshape(-1, n_columns)[:, [*self._columns(), n_columns - 1]]
        weights = np.ones(n_rows)
        for _ in range(_ROUNDS):
            products = (known * np.repeat(weights, size)[:, None]).T @ known
            values = _solved(products, list(range(len(products) - 1)))
            left = (known[:, -1] - known[:, :-1] @ values).reshape(n_rows, size)
            lengths = np.sqrt((left**2).sum(axis=1))
            self._sigma = max(median(lengths) / np.sqrt(size), 1e-12)
            weights = 1.0 / (1.0 + (lengths / self._sigma) ** 2 / (size * _TUNING**2)) ** 2
        self._weight = float(weights.sum())
        blocks, parts = [], (np.array_split(each, _BLOCKS) for each in (rows, weights))
        for part, each in zip(*parts, strict=True):
            flat = part.reshape(-1, n_columns)
            blocks.append((flat * np.repeat(each, size)[:, None]).T @ flat)
        self._blocks = np.stack(blocks)
        # Noise of the columns would make the lever arm too short: at most half of them is noise.
        sizes, directions = np.linalg.eigh(self._blocks.sum(axis=0)[:3, :3])
        of_noise = np.minimum(noise * self._weight, 0.5 * np.maximum(sizes, 0.0))
        self._blocks[:, :3, :3] -= (directions * of_noise) @ directions.T / _BLOCKS
        self._total = self._blocks.sum(axis=0)

    def _columns(self, *groups: str, without: str = "") -> list[int]:
        names = [*(name for name in self._base if name != without), *groups]
        return [column for name in names for column in self._where[name]]

    def biases(self, group: str) -> FloatArray:
        """By how much (m,) noise of the columns of a group, if it is as large as that of the rows,
        may push its values.
        """
        at = self._where[group]
        return np.asarray(self._sigma**2 * self._weight / np.maximum(self._total[at, at], 1e-300))

    def fit(self, group: str, without: str = "") -> Fitted:
        """Fit a group beside the base, or beside what is left of it."""
        before = self._columns(without=without)
        known = [*before, *self._where[group]]
        # All rows, and all but those of each block.
        solved = _solved(np.concatenate([self._total[None], self._total - self._blocks]), known)
        values, left_out = solved[0], solved[1:, len(before) :]
        spread = left_out - left_out.mean(axis=0)
        costs = [
            float(self._total[-1, -1] - self._total[columns, -1] @ found)
            for columns, found in ((before, _solved(self._total, before)), (known, values))
        ]
        return Fitted(
            values=values[len(before) :],
            sigmas=np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum(axis=0)),
            share=1.0 - costs[1] / max(costs[0], 1e-300),
        )


def _solved(products: FloatArray, columns: list[int]) -> FloatArray:
    normal = products[..., columns, :][..., columns]
    units = 1.0 / np.sqrt(np.diagonal(normal, axis1=-2, axis2=-1) + 1e-300)
    balanced = normal * units[..., :, None] * units[..., None, :] + 1e-9 * np.eye(len(columns))
    pushed = (units * products[..., columns, -1])[..., None]
    return np.asarray(units * np.linalg.solve(balanced, pushed)[..., 0])


class _Stream:
    """Motions of a stream over a span, in the parent's axes: ``turned`` (3, 3) by X or not at all.
    Displacements are seen from the pose half-way, whose errors are not those of the ends.
    """

    def __init__(self, poses: FloatArray, pairs: MotionPairs, turned: FloatArray) -> None:
        self._poses, self._turned = poses, turned
        self.rows = pairs.i, (pairs.i + pairs.j) // 2, pairs.j
        start, middle, end = (poses[rows] for rows in self.rows)
        self.from_world = turned @ np.swapaxes(middle[:, :3, :3], 1, 2)
        self.ends = self.from_world @ start[:, :3, :3], self.from_world @ end[:, :3, :3]
        self.chords = self.ends[1] - self.ends[0]
        self.rotations = turned @ np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3] @ turned.T
        self.displaced = end[:, :3, 3] - start[:, :3, 3]
        self.moved = _times(self.from_world, self.displaced)

    def back(self, vectors: FloatArray) -> FloatArray:
        """Vectors (N, 3) of the poses at the start less those at the end, in axes of the start."""
        start, _, end = (vectors[rows] for rows in self.rows)
        return start - _times(self.rotations, end)

    def derivatives(self, step: int, h: float) -> tuple[FloatArray, ...]:
        """Velocity and acceleration (N, 3) of all poses in their world, angular velocity and
        acceleration in the parent's axes, by differences over steps of ``h`` seconds.
        """
        p, n = self._poses[:, :3, 3], len(self._poses)
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
    """Regression of motions over some seconds, and the principal axes of the rotations (columns,
    parent's frame).

    Groups: ``turned_child``, ``turned_parent``, ``turned_both``: positions turned against
    orientations, a rotation vector in the stream's world, of both in the parent's; ``axes_child``,
    ``axes_parent``: factors, less 1, of the coordinates of a stream's positions; ``drift``:
    velocity and angular rate of the child's world; ``gain``: factors, less 1, of the child's
    rotations about the principal axes; ``moved``: lever arm and rotation of X after a time, if one
    is given.
    """
    parent = _Stream(pose_pairs.Ts_pw_p, motions, np.eye(3))
    child = _Stream(pose_pairs.Ts_cw_c, motions, T_parent_child[:3, :3])
    # What the other stream makes of the displacements of each.
    arm = _times(parent.chords, T_parent_child[:3, 3])
    p_seen = _times(np.swapaxes(parent.from_world, 1, 2), child.moved - arm)
    c_seen = _times(np.swapaxes(child.from_world, 1, 2), parent.moved + arm)
    seconds = (pose_pairs.stamps_ns[motions.j] - pose_pairs.stamps_ns[motions.i]) * 1e-9
    drifted = child.from_world * seconds[:, None, None]
    middle = pose_pairs.Ts_cw_c[motions.i, :3, 3] + 0.5 * child.displaced
    middle = middle - middle.mean(axis=0)
    x = se3.rotation_log(parent.rotations)
    axes = np.linalg.eigh(x.T @ x)[1][:, ::-1]
    turned_child = -child.from_world @ se3.skew(child.displaced)
    turned_parent = parent.from_world @ se3.skew(parent.displaced)
    worlds = (np.swapaxes(child.from_world, 1, 2) @ parent.from_world).mean(axis=0)
    none = np.zeros_like(drifted)
    groups = {
        "turned_child": (turned_child, none),
        "turned_parent": (turned_parent, none),
        "turned_both": (turned_parent + turned_child @ se3.nearest_rotation(worlds), none),
        "axes_child": (child.from_world * c_seen[:, None, :], none),
        "axes_parent": (-parent.from_world * p_seen[:, None, :], none),
        "drift": (
            np.concatenate([drifted, -drifted @ se3.skew(middle)], axis=2),
            np.concatenate([none, drifted], axis=2),
        ),
        "gain": (none, (x @ axes)[:, None, :] * axes[None]),
    }
    after = None
    if moved_at_ns is not None:
        stamps_ns = pose_pairs.stamps_ns
        after = (stamps_ns[motions.i] + stamps_ns[motions.j]) // 2 >= moved_at_ns
    return _regression(parent, child, T_parent_child, groups, (), after), axes


def delays(
    pose_pairs: PosePairs, motions: MotionPairs, T_parent_child: FloatArray
) -> Regression | None:
    """Regression of motions over less than a second; None if too few poses follow each other.

    Groups: ``late_child``, ``late_parent``: positions are late against the orientations of their
    stream (s); ``late_axes_child``, ``late_axes_parent``: those by coordinate;
    ``positions_child``, ``positions_parent``, ``orientations_child``, ``orientations_parent``:
    smoothed (s^2).
    """
    stamps_ns = pose_pairs.stamps_ns
    interval_s = median(np.diff(stamps_ns)) * 1e-9
    step = max(round(_STEP_S / interval_s), 1)
    h = step * interval_s
    follow = np.zeros(len(stamps_ns), dtype=bool)
    inner = np.arange(2 * step, len(stamps_ns) - 2 * step)
    follow[inner] = True
    for k in (-2, -1, 1, 2):
        elapsed_s = (stamps_ns[inner + k * step] - stamps_ns[inner]) * 1e-9
        follow[inner] &= np.abs(elapsed_s - k * h) < _TOLERANCE * h
    motions = motions[follow[motions.i] & follow[motions.j] & follow[(motions.i + motions.j) // 2]]
    if len(motions) < _MIN_MOTIONS * _BLOCKS:
        return None
    parent = _Stream(pose_pairs.Ts_pw_p, motions, np.eye(3))
    child = _Stream(pose_pairs.Ts_cw_c, motions, T_parent_child[:3, :3])
    none, groups = np.zeros_like(child.chords), {}
    for name, sign, stream in (("child", -1.0, child), ("parent", 1.0, parent)):
        velocity, acceleration, rate, bend = stream.derivatives(step, h)
        start, middle, end = stream.rows
        faster = sign * (velocity[end] - velocity[start])
        bent = sign * (acceleration[start] - acceleration[end])
        by_axis = stream.from_world * faster[:, None, :]
        late, positions = _times(stream.from_world, faster), _times(stream.from_world, bent)
        orientations = sign * se3.cross(bend[middle], stream.moved)
        if name == "child":
            whole = late + se3.cross(rate[middle], stream.moved), stream.back(rate)
            groups["late"] = whole[0][:, :, None], whole[1][:, :, None]
        else:
            arms = [se3.cross(bend[rows], T_parent_child[:3, 3]) for rows in (start, end)]
            orientations += _times(stream.ends[0], arms[0]) - _times(stream.ends[1], arms[1])
        of_rotation = (sign * stream.back(bend))[:, :, None]
        groups[f"late_{name}"] = late[:, :, None], none[:, :, :1]
        groups[f"late_axes_{name}"] = by_axis, none
        groups[f"positions_{name}"] = positions[:, :, None], none[:, :, :1]
        groups[f"orientations_{name}"] = orientations[:, :, None], of_rotation
    return _regression(parent, child, T_parent_child, groups, ("late",))


def _regression(
    parent: _Stream,
    child: _Stream,
    T_parent_child: FloatArray,
    groups: Mapping[str, tuple[FloatArray, FloatArray]],
    base: Sequence[str],
    after: BoolArray | None = None,
) -> Regression:
    """Regression on groups of columns, of displacements and of rotations, and on those of X and the
    scale; on those of X again, as ``moved``, of the motions (K,) after some time.
    """
    displaced = child.moved - parent.moved
    turned = se3.rotation_log(child.rotations @ np.swapaxes(parent.rotations, 1, 2))
    unexplained = displaced - _times(parent.chords, T_parent_child[:3, 3])
    unit_t, unit_r = (
        max(robust_sigma(v), least) for v, least in ((unexplained, 1e-7), (turned, 1e-8))
    )
    of_mount = {
        "lever": (parent.chords, np.zeros_like(parent.chords)),
        "rotation": (se3.skew(child.moved), child.rotations - np.eye(3)),
        "scale": (child.moved[:, :, None], np.zeros((len(turned), 3, 1))),
    }
    columns = of_mount | dict(groups)
    if after is not None:
        of_x = zip(columns["lever"], columns["rotation"], strict=True)
        columns["moved"] = tuple(after[:, None, None] * np.concatenate(x, axis=2) for x in of_x)
    columns["target"] = displaced[:, :, None], turned[:, :, None]
    ends = np.cumsum([of_t.shape[2] for of_t, _ in columns.values()]).tolist()
    rows = np.empty((len(turned), 6, ends[-1]))
    where = {}
    for name, start, end in zip(columns, [0, *ends], ends, strict=False):
        where[name] = list(range(start, end))
        of_t, of_r = columns[name]
        np.divide(of_t, unit_t, out=rows[:, :3, start:end])
        np.divide(of_r, unit_r, out=rows[:, 3:, start:end])
    return Regression(rows, where, (*of_mount, *base), (unit_r / unit_t) ** 2)


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[..., None])[..., 0])
