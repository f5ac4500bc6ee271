"""References: which index pairs (i, j) become motion pairs (Välimäki et al. 2023, sect. 3.4)."""

import re

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.errors import ConfigError

_PATTERN = re.compile(r"A|([BC])([1-9][0-9]{0,8})")


def parse_reference(reference: str) -> tuple[str, int]:
    """Split a reference into its kind ("A", "B" or "C") and its step (1 for "A").

    Raises
    ------
    ConfigError
        If it is not A, B<n> with n >= 1, or C<n> with n >= 2.
    """
    match = _PATTERN.fullmatch(reference) if isinstance(reference, str) else None
    if match and reference == "A":
        return "A", 1
    if match and (match[1] == "B" or int(match[2]) >= 2):
        return match[1], int(match[2])
    raise ConfigError(
        f"reference {str(reference)[:40]!r} is not one of A, B<n> (n >= 1) or C<n> (n >= 2), "
        "for example B5"
    )


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
        If the reference has another form.
    """
    kind, step = parse_reference(reference)
    if kind == "A":
        j = np.arange(1, n_poses)
        return np.zeros_like(j), j
    if kind == "B":
        j = np.arange(step, n_poses)
        return j - step, j
    keyframes = np.arange(0, max(n_poses - step, 0), step)
    j = (keyframes[:, None] + np.arange(1, step)).ravel()
    return np.repeat(keyframes, step - 1), j
