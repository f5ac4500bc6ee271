"""Checks of a calibrator's saved state, which may come from a file that somebody changed."""

from collections.abc import Mapping

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import ROTATION_TOLERANCE

_N_STATISTICS = 6
_LARGEST_COUNT = 1 << 53


def check_state(state: Mapping[str, np.ndarray], streams: tuple[str, ...], capacity: int) -> None:
    """Refuse a state that no calibrator gave.

    Parameters
    ----------
    state : mapping of str to arrays
        As of :meth:`~hand_eye_calib.engine.calibrator.Calibrator.state`.
    streams : tuple of str
    capacity : int
        Most poses of a stream.

    Raises
    ------
    InputError
        The message names the part that cannot be right.
    """
    for stream in streams:
        n_poses = _check_stamps(state, f"{stream}.stamps_ns")
        if n_poses > capacity:
            raise InputError(f"the saved state has {n_poses} poses of the {stream} stream")
        _check(state, f"{stream}.poses", (n_poses, 7))
        _check(state, f"{stream}.frame", (), kind="U")
        counts = _check(state, f"{stream}.statistics", (_N_STATISTICS,), kind="i")[:4]
        if (counts < 0).any() or (counts > _LARGEST_COUNT).any():
            raise InputError(f"the saved state has impossible {stream}.statistics")
    n_pairs = _check_stamps(state, "kept.stamps_ns")
    for name in ("kept.Ts_pw_p", "kept.Ts_cw_c"):
        _check_transforms(_check(state, name, (n_pairs, 4, 4)), name)
    _check(state, "base", (), kind="U")


def _check(
    state: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], kind: str = "f"
) -> np.ndarray:
    """An array of the state, of this shape and kind, with finite values."""
    array = state.get(name)
    if array is None or array.shape != shape or array.dtype.kind != kind:
        raise InputError(f"the saved state has no {name} that can be right")
    if kind == "f" and not np.isfinite(array).all():
        raise InputError(f"the saved state has values in {name} that are not finite")
    return array


def _check_stamps(state: Mapping[str, np.ndarray], name: str) -> int:
    """Number of stamps, which must increase."""
    array = state.get(name)
    if array is None or array.dtype != np.int64 or array.ndim != 1:
        raise InputError(f"the saved state has no {name} that can be right")
    if (array[1:] <= array[:-1]).any():
        raise InputError(f"the saved state has stamps in {name} that do not increase")
    return len(array)


def _check_transforms(Ts: np.ndarray, name: str) -> None:
    rotations = Ts[:, :3, :3]
    products = rotations @ np.swapaxes(rotations, 1, 2)
    deviation = np.abs(products - np.eye(3)).max(initial=0.0)
    if not deviation <= ROTATION_TOLERANCE:
        raise InputError(f"the saved state has matrices in {name} that are no transforms")
