"""Pairs of relative motions, what every AX = XB solver starts from."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.references import reference_indices


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
        """Residuals of AX = XB at a transform, per pair.

        Parameters
        ----------
        T_parent_child : (4, 4) array
            X.

        Returns
        -------
        translation : (K, 3) array
            See :meth:`translation_residuals`.
        rotation : (K, 3) array
            See :meth:`rotation_residuals`.
        """
        return self.translation_residuals(T_parent_child), self.rotation_residuals(T_parent_child)

    def translation_residuals(self, T_parent_child: FloatArray) -> FloatArray:
        """``R_A t + t_A - R t_B - t`` (K, 3), in m, in the axes of the parent sensor at instant i.

        It is the residual of Välimäki et al. 2023, eq. (6). The article prints its last term with
        the opposite sign; its published results have this one.
        """
        rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
        chord = self.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
        moved_child = self.Ts_childi_childj[:, :3, 3] @ rotation.T
        return chord @ translation + self.Ts_parenti_parentj[:, :3, 3] - moved_child

    def rotation_residuals(self, T_parent_child: FloatArray) -> FloatArray:
        """Rotation vectors (K, 3), in rad, in the axes of the child sensor at instant j, of the
        rotation from ``R_A R`` to ``R R_B``. Their lengths are the angles of eq. (7).
        """
        rotation = T_parent_child[:3, :3]
        via_parent = self.Ts_parenti_parentj[:, :3, :3] @ rotation
        via_child = rotation @ self.Ts_childi_childj[:, :3, :3]
        return se3.rotation_log(np.swapaxes(via_parent, 1, 2) @ via_child)


def motion_pairs(Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, reference: str) -> MotionPairs:
    """Relative motions of two synchronised trajectories (Välimäki et al. 2023, eqs 1-2).

    Parameters
    ----------
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child sensor in their own worlds at the same N instants.
    reference : str
        A, B<n> or C<n>; see :func:`~hand_eye_calib.pairing.references.reference_indices`.

    Raises
    ------
    InputError
        If the two stacks differ in length.
    ConfigError
        If the reference is none of these.
    """
    if len(Ts_pw_p) != len(Ts_cw_c):
        raise InputError(
            "parent and child need the same number of poses; "
            f"found {len(Ts_pw_p)} and {len(Ts_cw_c)}"
        )
    return pairs_between(Ts_pw_p, Ts_cw_c, *reference_indices(reference, len(Ts_pw_p)))


def pairs_between(
    Ts_pw_p: FloatArray, Ts_cw_c: FloatArray, i: IntArray, j: IntArray
) -> MotionPairs:
    """MotionPairs from the instants i to the instants j, (K,) int arrays."""
    return MotionPairs(_relative(Ts_pw_p, i, j), _relative(Ts_cw_c, i, j), i, j)


def _relative(Ts_world_sensor: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    start, end = Ts_world_sensor.take(i, axis=0), Ts_world_sensor.take(j, axis=0)
    # The translation difference is taken before rotating: with map coordinates of 1e6 m, inverting
    # first costs ten digits.
    end[:, :3, 3] -= start[:, :3, 3]
    relative = np.empty_like(end)
    np.matmul(np.swapaxes(start[:, :3, :3], 1, 2), end[:, :3], out=relative[:, :3])
    relative[:, 3] = 0.0, 0.0, 0.0, 1.0
    return relative
