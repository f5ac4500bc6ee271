"""What a drive has shown so far, and in plain words what it has not: for a person who is still
driving.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.assessment.covariance import AXES, WEAK_ROTATION, WEAK_TRANSLATION
from hand_eye_calib.calibration import DofVerdict
from hand_eye_calib.geometry import se3

# Poses looked at, spread evenly over the session: enough to see turns, few enough to cost a few
# milliseconds.
_MOST_POSES = 500

# A turn counts when so large a share of the motions has less of it: one outlier is not a turn.
_QUANTILE = 95

# Less turning than this reveals nothing of a lever (rad).
ENOUGH_TURNING = np.radians(5.0)

# Two turning axes must differ: turning about all but one is less than this share of the turning
# about that one.
_ONE_AXIS_SHARE = 0.04

# An axis is hidden when this share of it lies in the direction that shows least.
_HIDDEN_SHARE = 0.1

_TURNS = dict(zip("xyz", AXES[3:], strict=True))


@dataclass(frozen=True)
class Excitation:
    """How the parent sensor has moved, in its own axes.

    Attributes
    ----------
    n_poses : int
        Synchronised pose pairs of the session.
    turned : (3,) array
        How far it has turned about x, y and z, rad: the largest over all spans of time of the 95th
        percentile over the session.
    gain : (3,) array
        Root mean square of the displacement that an offset of 1 m along x, y and z causes, m: how
        well that offset shows. 0 to 2.
    worst : (3,) array
        Unit vector of the offset that shows least.
    worst_gain : float
        Its gain.
    distance : float
        Length of the path, m.
    """

    n_poses: int
    turned: np.ndarray
    gain: np.ndarray
    worst: np.ndarray
    worst_gain: float
    distance: float


def excitation(pose_pairs):
    """The Excitation in synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs

    Returns
    -------
    Excitation
    """
    n_poses = len(pose_pairs)
    if n_poses < 2:
        return Excitation(n_poses, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 0.0)
    poses = pose_pairs.Ts_pw_p[
        np.unique(np.linspace(0, n_poses - 1, min(n_poses, _MOST_POSES)).astype(int))
    ]
    turned, information = np.zeros(3), np.zeros((3, 3))
    lag = 1
    while lag < len(poses):
        rotations = np.swapaxes(poses[:-lag, :3, :3], 1, 2) @ poses[lag:, :3, :3]
        turned = np.maximum(
            turned, np.percentile(np.abs(se3.rotation_log(rotations)), _QUANTILE, axis=0)
        )
        moved = rotations - np.eye(3)
        at_lag = np.einsum("kai,kaj->ij", moved, moved) / len(moved)
        if np.trace(at_lag) > np.trace(information):
            information = at_lag
        lag *= 2
    powers, directions = np.linalg.eigh(information)
    gain = np.sqrt(np.maximum(np.diag(information), 0.0))
    distance = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    return Excitation(
        n_poses, turned, gain, directions[:, 0], float(np.sqrt(max(powers[0], 0.0))), distance
    )


def what_is_missing(seen, calibration=None):
    """One sentence for the driver: what the motion so far does not show, and what to do about it.

    Parameters
    ----------
    seen : Excitation
        Of the parent sensor; x, y, z are its axes.
    calibration : Calibration, optional
        The answer from those poses; its verdicts count where there is one.

    Returns
    -------
    str
        Empty where nothing is missing.
    """
    hidden = calibration.unobservable() if calibration else _hidden(seen)
    if not hidden:
        return _weak(calibration) if calibration else ""
    if seen.turned.max() < ENOUGH_TURNING:
        return (
            f"hardly any turning so far (at most {_degrees(seen.turned.max())}): {_list(hidden)} not observable, "
            "drive curves in both directions"
        )
    fine = [
        axis for axis, turned in zip("xyz", seen.turned, strict=True) if turned >= ENOUGH_TURNING
    ]
    small = [axis for axis in "xyz" if axis not in fine]
    said = f"turning about {_list(fine)} is fine ({_list([_degrees(seen.turned['xyz'.index(axis)]) for axis in fine])})"
    if small:
        most = max(seen.turned["xyz".index(axis)] for axis in small)
        said += f"; {_list([_TURNS[axis] for axis in small])} under {_degrees(most, up=True)}"
    return f"{said}: {_list([_called(name) for name in hidden])} not observable, {_advice(hidden, small)}"


def _hidden(seen):
    """What the motion cannot show, whatever the noise."""
    if seen.turned.max() < ENOUGH_TURNING:
        return list(AXES[:3])
    if seen.worst_gain > _ONE_AXIS_SHARE * seen.gain.max():
        return []
    return [axis for axis, share in zip("xyz", seen.worst**2, strict=True) if share > _HIDDEN_SHARE]


def _called(name):
    return {"z": "vertical offset (z)"}.get(name, f"offset {name}" if name in "xyz" else name)


def _advice(hidden, small):
    if not any(name in "xyz" for name in hidden):
        return "turn about other axes as well"
    if len(small) >= 2:
        return "drive over a ramp or a kerb, or measure it by hand"
    return "turn further about the other axes"


def _weak(calibration):
    weak = [dof for dof in calibration.observability if dof.verdict is DofVerdict.WEAK]
    if not weak:
        return ""
    limits = f"{WEAK_TRANSLATION * 100:g} cm or {np.degrees(WEAK_ROTATION):g} deg"
    return f"{_list([_sigma(dof) for dof in weak])} still more uncertain than {limits}: go on driving, with more turns"


def _sigma(dof):
    return (
        f"{dof.name} (+/- {dof.sigma * 100:.0f} cm)"
        if dof.name in "xyz"
        else f"{dof.name} (+/- {np.degrees(dof.sigma):.1f} deg)"
    )


def _degrees(angle, up=False):
    degrees = np.degrees(angle)
    if up:
        degrees = max(np.ceil(degrees), 1.0)
    return f"{degrees:.0f} deg" if degrees >= 10 or up else f"{degrees:.1f} deg"


def _list(words):
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
