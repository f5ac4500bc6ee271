"""Estimate the factor from the child's unit of length to the parent's."""

from collections.abc import Sequence
from dataclasses import replace

from hand_eye_calib.core.alignment.similarity import (
    MAX_UNEXPLAINED_TRANSLATION,
    MIN_PAIRS,
    SimilarityFit,
    fit_similarity,
)
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, pairs_over

# Durations (s) of the motions from which the scale is estimated; the most certain estimate is used.
# Long motions usually determine the scale best.
_SCALE_LAGS_S = (3.0, 1.0, 8.0)


def estimate_scale(
    pose_pairs: PosePairs, first_fits: Sequence[SimilarityFit] = ()
) -> SimilarityFit:
    """Estimate the factor from the child's unit of length to the parent's.

    The child's lengths are the regressor, so noise of the child makes the factor too small. The
    standard deviation does not contain this bias. With exchanged streams, the factor is too large.
    The units of length differ (``has_own_unit``) only if they differ in both fits.

    Parameters
    ----------
    pose_pairs : PosePairs
    first_fits : sequence of SimilarityFit, optional
        Existing fits of the same streams, over the first durations in _SCALE_LAGS_S. By default all
        fits are computed.

    Returns
    -------
    SimilarityFit
        Fit with the smallest relative standard deviation of the scale.

    Raises
    ------
    NotEnoughDataError
        If there are too few poses.
    """
    best = _best_scale(pose_pairs, first_fits)
    if not best.has_own_unit:
        return best
    exchanged = replace(
        pose_pairs, Ts_pw_p=pose_pairs.Ts_cw_c, Ts_cw_c=pose_pairs.Ts_pw_p
    )
    T_child_parent = se3.inverse(best.T_parent_child)
    T_child_parent[:3, 3] /= best.scale
    start = replace(best, T_parent_child=T_child_parent, scale=1.0 / best.scale)
    of_exchanged = _best_scale(exchanged, (), start)
    return replace(
        best,
        has_own_unit=of_exchanged.has_own_unit,
        scale_bias=abs(1.0 / of_exchanged.scale - best.scale),
    )


def _best_scale(
    pose_pairs: PosePairs,
    first_fits: Sequence[SimilarityFit],
    start: SimilarityFit | None = None,
) -> SimilarityFit:
    """Return the fit whose scale has the smallest relative standard deviation.

    If a fit does not explain the translations, their unexplained share is added to its standard
    deviation. ``start`` is the initial value of the first fit.
    """
    fits = [*first_fits]
    for lag_s in _SCALE_LAGS_S[len(fits) :]:
        pairs = pairs_over(pose_pairs, lag_s)
        if len(pairs) >= MIN_PAIRS:
            fits.append(
                fit_similarity(pairs, start=fits[-1] if fits else start)
            )
    if not fits:
        raise NotEnoughDataError(
            f"the scale cannot be estimated from {len(pose_pairs)} pose pairs: fewer than "
            f"{MIN_PAIRS} of them are {min(_SCALE_LAGS_S):g} s apart; record longer, or give scale"
        )

    def doubt(fit: SimilarityFit) -> float:
        relative_sigma = fit.scale_sigma / fit.scale
        return relative_sigma + (
            0.0 if fit.explains_translation else fit.unexplained_translation
        )

    return min(fits, key=doubt)


def settle_scale(
    pose_pairs: PosePairs, option: str | float
) -> tuple[float, SimilarityFit | None]:
    """Return the scale according to the option ``scale``, and its fit if it was estimated.

    Parameters
    ----------
    pose_pairs : PosePairs
    option : str or float
        A number is the scale itself; "none" stands for 1, and "estimate" for an estimate. "auto"
        stands for an estimate if the units of length certainly differ, and for 1 otherwise.

    Raises
    ------
    NotEnoughDataError
        With "estimate", if the scale cannot be estimated. With "auto", if the units differ and the
        fit does not explain the translations.
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
    if option == "auto" and not fit.has_own_unit:
        return 1.0, None
    if not fit.explains_translation:
        raise NotEnoughDataError(
            "the scale cannot be estimated: even with a scale, "
            f"{min(fit.unexplained_translation, 1.0):.0%} of the motion stays unexplained "
            f"(at most {MAX_UNEXPLAINED_TRANSLATION:.0%} is allowed); "
            "check the streams, or give scale"
        )
    return fit.scale, fit
