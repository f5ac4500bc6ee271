"""``reference: auto``: the reference with the smallest predicted translation error."""

import numpy as np

from hand_eye_calib.errors import NotEnoughDataError

CANDIDATES = ("B1", "B2", "B3", "B5", "B7", "B10", "B15", "B20", "C5", "C10")

# A reference must leave at least this many motion pairs to be considered.
_FEWEST_PAIRS = 12


def select_reference(evaluate, n_poses, candidates=CANDIDATES):
    """Solve with every candidate and pick the one whose covariance predicts the smallest translation error.

    The residual cannot tell which reference is best (Välimäki et al. 2023, section 4.2); the scatter of the answer over blocks of
    the drive can.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(reference)`` returns an object with ``pairs`` and ``assessment``.
    n_poses : int
    candidates : sequence of str

    Returns
    -------
    The winner's evaluation.

    Raises
    ------
    NotEnoughDataError
        Where no candidate leaves enough pairs.
    """
    best, best_variance = None, np.inf
    for reference in candidates:
        if int(reference[1:]) > n_poses - _FEWEST_PAIRS:
            continue
        evaluation = evaluate(reference)
        if len(evaluation.pairs) < _FEWEST_PAIRS:
            continue
        variance = float(np.trace(evaluation.assessment.cov_parent_child_in_child[:3, :3]))
        if variance < best_variance:
            best, best_variance = evaluation, variance
    if best is None:
        raise NotEnoughDataError(
            f"reference auto needs more than {_FEWEST_PAIRS} synchronised poses, found {n_poses}; drive on, or name a reference"
        )
    return best
