"""Error metrics of Välimäki et al. 2023, section 3.3. Metres and radians."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.geometry import se3


@dataclass(frozen=True)
class Errors:
    """The four metrics of one calibration.

    Attributes
    ----------
    e_rt, e_rR : float
        Mean relative translation (m) and rotation error (rad) over the motion pairs. They need no
        ground truth, and do not tell which of two calibrations is nearer to it.
    e_at, e_aR : float
        Absolute translation (m) and rotation error (rad) against the ground truth.
    """

    e_rt: float
    e_rR: float
    e_at: float
    e_aR: float


def errors(pairs, T_parent_child, truth_T_parent_child):
    """All four metrics of a calibration; see :func:`relative_errors` and :func:`absolute_errors`."""
    return Errors(
        *relative_errors(pairs, T_parent_child),
        *absolute_errors(T_parent_child, truth_T_parent_child),
    )


def relative_errors(pairs, T_parent_child):
    """Mean relative errors e_rt and e_rR (eqs 6 and 7).

    The translation residual is ``R_A t + t_A - R t_B - t``; the article prints its last term with
    the opposite sign, its published numbers have this one.

    Parameters
    ----------
    pairs : MotionPairs
        K pairs, K >= 1.
    T_parent_child : (4, 4) array

    Returns
    -------
    e_rt, e_rR : float
        In m and rad.
    """
    via_parent = pairs.Ts_parenti_parentj @ T_parent_child
    via_child = T_parent_child @ pairs.Ts_childi_childj
    translation = np.linalg.norm((via_parent - via_child)[:, :3, 3], axis=1)
    rotation = _angle_between(via_child[:, :3, :3], via_parent[:, :3, :3])
    return float(translation.mean()), float(rotation.mean())


def absolute_errors(T_parent_child, truth_T_parent_child):
    """Absolute errors e_at and e_aR (eqs 8 and 9), in m and rad, of a transform (4, 4) against the
    true one.
    """
    translation = np.linalg.norm(truth_T_parent_child[:3, 3] - T_parent_child[:3, 3])
    return float(translation), float(
        _angle_between(T_parent_child[:3, :3], truth_T_parent_child[:3, :3])
    )


def deviation(T_parent_child, T_reference):
    """How far one answer is from another: (6,) array, m along and rad about the axes of the parent
    sensor's frame.
    """
    rotation = se3.rotation_log(T_parent_child[:3, :3] @ T_reference[:3, :3].T)
    return np.r_[T_parent_child[:3, 3] - T_reference[:3, 3], rotation]


def _angle_between(first, second):
    return se3.rotation_angle(np.swapaxes(first, -1, -2) @ second)
