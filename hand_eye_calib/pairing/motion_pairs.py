"""Pairs of relative motions, what every AX = XB solver starts from."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import median
from hand_eye_calib.text import parse_reference

# Pairs that are compared where the choice of poses is free.
MAX_PAIRS = 800


def reference_indices(reference: str, n_poses: int) -> tuple[IntArray, IntArray]:
    """Index pairs of a reference.

    Parameters
    ----------
    reference : str
        ``"A"``: every pose with the first. ``"B<n>"``: with the n-th before it. ``"C<n>"``: with
        the keyframe that starts its segment of n poses; a last segment whose keyframe is N - n or
        later is left out, as in the published results.
    n_poses : int
        Number of poses N.

    Returns
    -------
    i, j : (K,) int arrays
        Motion k runs from pose ``i[k]`` to pose ``j[k]``; K is 0 if there are too few poses.

    Raises
    ------
    ConfigError
        If the reference has another form: n is at least 1, of C at least 2.
    """
    kind, step = parse_reference("reference", reference)
    if kind == "A":
        j = np.arange(1, n_poses)
        return np.zeros_like(j), j
    if kind == "B":
        j = np.arange(step, n_poses)
        return j - step, j
    keyframes = np.arange(0, max(n_poses - step, 0), step)
    j = (keyframes[:, None] + np.arange(1, step)).ravel()
    return np.repeat(keyframes, step - 1), j


@dataclass(frozen=True)
class MotionPairs:
    """K relative motions of both sensors between the same instants i and j.

    Attributes
    ----------
    Ts_parenti_parentj : (K, 4, 4) array
        Motion of the parent sensor, ``inv(T_pw_p(i)) @ T_pw_p(j)``: A of AX = XB.
    Ts_childi_childj : (K, 4, 4) array
        Motion of the child sensor: B.
    i, j : (K,) int arrays
        Indices of the poses the motions run between.
    """

    Ts_parenti_parentj: FloatArray
    Ts_childi_childj: FloatArray
    i: IntArray
    j: IntArray

    def __len__(self) -> int:
        return len(self.i)

    def __getitem__(self, index: slice | NDArray[Any]) -> Self:
        return type(self)(
            self.Ts_parenti_parentj[index],
            self.Ts_childi_childj[index],
            self.i[index],
            self.j[index],
        )

    def residuals(self, T_parent_child: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (K, 3) of translation and of rotation at X (4, 4).

        ``R_A t + t_A - R t_B - t``, in m, in the axes of the parent sensor at instant i: Välimäki
        et al. 2023, eq. (6). The article prints its last term with the opposite sign; its published
        results have this one. Rotation vectors, in rad, in the axes of the child sensor at instant
        j, of the rotation from ``R_A R`` to ``R R_B``; their lengths are the angles of eq. (7).
        """
        rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
        chord = self.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        moved_child = self.Ts_childi_childj[:, :3, 3] @ rotation.T
        apart = chord @ translation + self.Ts_parenti_parentj[:, :3, 3] - moved_child
        via_parent = self.Ts_parenti_parentj[:, :3, :3] @ rotation
        via_child = rotation @ self.Ts_childi_childj[:, :3, :3]
        return apart, se3.rotation_log(np.swapaxes(via_parent, 1, 2) @ via_child)


def motion_pairs(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, reference: str) -> MotionPairs:
    """Relative motions of two synchronised trajectories (Välimäki et al. 2023, eqs 1-2).

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child sensor in their own worlds at the same N instants.
    reference : str
        A, B<n> or C<n>; see :func:`~hand_eye_calib.pairing.motion_pairs.reference_indices`, also
        for its errors.
    """
    return pairs_between(Ts_pw_p, Ts_cw_c, *reference_indices(reference, len(Ts_pw_p)))


def pairs_between(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, i: IntArray, j: IntArray
) -> MotionPairs:
    """MotionPairs from the instants i to the instants j, (K,) int arrays."""
    motions = []
    for Ts_world_sensor in (Ts_pw_p, Ts_cw_c):
        start, end = Ts_world_sensor.take(i, axis=0), Ts_world_sensor.take(j, axis=0)
        # The translation difference is taken before rotating: with map coordinates of 1e6 m,
        # inverting first costs ten digits.
        end[:, :3, 3] -= start[:, :3, 3]
        relative = np.empty_like(end)
        np.matmul(np.swapaxes(start[:, :3, :3], 1, 2), end[:, :3], out=relative[:, :3])
        relative[:, 3] = 0.0, 0.0, 0.0, 1.0
        motions.append(relative)
    return MotionPairs(motions[0], motions[1], i, j)


def pairs_over(pose_pairs: PosePairs, lag_s: float, max_pairs: int = MAX_PAIRS) -> MotionPairs:
    """Motion pairs between poses about ``lag_s`` seconds apart (their interval if that is longer),
    evenly over the recording; none if no two poses lie that far apart.
    """
    stamps_ns = pose_pairs.stamps_ns
    if len(stamps_ns) > 1:
        lag_s = max(lag_s, median(np.diff(stamps_ns)) * 1e-9)
    i = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), max_pairs)).astype(int)
    j = np.searchsorted(stamps_ns, stamps_ns[i] + round(lag_s * 1e9) - 1000)
    i, j = i[j < len(stamps_ns)], j[j < len(stamps_ns)]
    near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i[near], j[near])
