"""Pairs of relative motions, what every AX = XB solver starts from."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.errors import InputError
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

    Ts_parenti_parentj: np.ndarray
    Ts_childi_childj: np.ndarray
    i: np.ndarray
    j: np.ndarray

    def __len__(self):
        return len(self.i)

    def __getitem__(self, index):
        return MotionPairs(
            self.Ts_parenti_parentj[index],
            self.Ts_childi_childj[index],
            self.i[index],
            self.j[index],
        )


def motion_pairs(Ts_pw_p, Ts_cw_c, reference):
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
        Where the two stacks differ in length.
    """
    if len(Ts_pw_p) != len(Ts_cw_c):
        raise InputError(
            f"parent and child need the same number of poses; found {len(Ts_pw_p)} and {len(Ts_cw_c)}"
        )
    return pairs_between(Ts_pw_p, Ts_cw_c, *reference_indices(reference, len(Ts_pw_p)))


def pairs_between(Ts_pw_p, Ts_cw_c, i, j):
    """MotionPairs from the instants i to the instants j, (K,) int arrays."""
    return MotionPairs(_relative(Ts_pw_p, i, j), _relative(Ts_cw_c, i, j), i, j)


def _relative(Ts_world_sensor, i, j):
    start, end = Ts_world_sensor.take(i, axis=0), Ts_world_sensor.take(j, axis=0)
    # The translation difference is taken before rotating: with map coordinates of 1e6 m, inverting
    # first costs ten digits.
    end[:, :3, 3] -= start[:, :3, 3]
    relative = np.empty_like(end)
    np.matmul(np.swapaxes(start[:, :3, :3], 1, 2), end[:, :3], out=relative[:, :3])
    relative[:, 3] = 0.0, 0.0, 0.0, 1.0
    return relative
