"""The scale: factor from the child's unit of length to the parent's."""

from hand_eye_calib.alignment.similarity import (
    MAX_UNEXPLAINED_TRANSLATION,
    SimilarityFit,
    fit_similarity,
)
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.pairing.motion_pairs import pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs

# Motions over these times (s) are compared; the lag with the smallest relative standard deviation
# wins. Long motions show the scale best.
_LAGS_S = (3.0, 1.0, 8.0)
_MIN_PAIRS = 20

# A scale differs from 1 if it is off by more than this and by so many standard deviations, and if
# the fit leaves less than this of the motion unexplained: many jumps could imitate a scale.
_MIN_DIFFERENCE, _MIN_SIGMAS, _MAX_UNEXPLAINED_TO_DIFFER = 0.01, 5.0, 0.1


def estimate_scale(pose_pairs: PosePairs, start: SimilarityFit | None = None) -> SimilarityFit:
    """Estimate the factor from the child's unit of length to the parent's.

    Parameters
    ----------
    pose_pairs : PosePairs
    start : SimilarityFit, optional
        Fit of the same streams to start at; a start is searched for without one.

    Raises
    ------
    NotEnoughDataError
        If there are too few poses.
    """
    fits: list[SimilarityFit] = []
    for lag_s in _LAGS_S:
        pairs = pairs_over(pose_pairs, lag_s)
        if len(pairs) >= _MIN_PAIRS:
            fits.append(fit_similarity(pairs, start=fits[-1] if fits else start))
    if not fits:
        raise NotEnoughDataError(
            f"the scale cannot be estimated from {len(pose_pairs)} pose pairs: fewer than "
            f"{_MIN_PAIRS} of them are {min(_LAGS_S):g} s apart; record longer, or give scale"
        )
    # By the relative standard deviation, plus the unexplained share if the fit does not hold.
    return min(
        fits,
        key=lambda fit: (
            fit.scale_sigma / fit.scale
            + (0.0 if fit.explains_translation else fit.unexplained_translation)
        ),
    )


def scale_differs(fit: SimilarityFit) -> bool:
    """Whether the lengths of two streams differ significantly, and by enough to matter."""
    significant = abs(fit.scale - 1.0) > max(_MIN_DIFFERENCE, _MIN_SIGMAS * fit.scale_sigma)
    return significant and fit.unexplained_translation < _MAX_UNEXPLAINED_TO_DIFFER


def settle_scale(pose_pairs: PosePairs, option: str | float) -> tuple[float, SimilarityFit | None]:
    """The scale to use, given or estimated as the option ``scale`` asks for, and the fit that it
    comes from if it was estimated.

    Raises
    ------
    NotEnoughDataError
        If it is to be estimated and cannot be.
    """
    if not isinstance(option, str):
        return option, None
    if option == "none":
        return 1.0, None
    try:
        fit = estimate_scale(pose_pairs)
    except NotEnoughDataError:
        if option == "estimate":
            raise
        return 1.0, None
    if option == "auto" and not scale_differs(fit):
        return 1.0, None
    if not fit.explains_translation:
        raise NotEnoughDataError(
            "the scale cannot be estimated: even with a scale, "
            f"{fit.unexplained_translation:.0%} of the motion stays unexplained "
            f"(at most {MAX_UNEXPLAINED_TRANSLATION:.0%} is allowed); "
            "check the streams, or give scale"
        )
    return fit.scale, fit
