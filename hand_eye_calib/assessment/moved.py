"""Has it moved? The one kernel behind comparisons of results, parts of a recording and the monitor.

A change of the extrinsic is judged in two ways, both from its estimate d and the covariance C of
that. By axis, where a person asks what has moved: an axis has if it differs by more than chance
makes of any of six once in 200 comparisons, or all together by what chance makes of them once in
1,000; it is the same only if a change that matters would have been seen. By probability, where a
shift is looked for at many times: with shifts of covariance L expected, the logarithm of the
likelihood ratio of a shift against none is, with ``H = C^-1`` and ``S = H d``,

    1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|,

both divided before by how much more S scatters than H predicts.

Answers of one rig scatter from recording to recording by more than each of them states, as no
recording shows its own constant errors: that belongs to C (docs/session.md has the measurements).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.results.status import AXES
from hand_eye_calib.stats import CHI2, LARGEST_OF_SIX, NINE_TIMES_OUT_OF_TEN
from hand_eye_calib.text import amount, listing

# Shifts that are looked for: one standard deviation per axis (m, rad).
SHIFT_M, SHIFT_RAD = 0.03, float(np.radians(1.0))

# Scatter between recordings of one rig, per axis (m, rad): of flights and hand-held recordings, and
# of vehicles. A vehicle turns about one axis, and knows the translation along it so many times
# worse than along the others.
_SCATTER_IN_HAND = np.repeat([0.008, np.radians(0.12)], 3)
_SCATTER_OF_VEHICLE = np.repeat([0.020, np.radians(0.10)], 3)
_VEHICLE = 4.0

# Standard deviations (m, rad) that stand for "nothing known", and share from which on one does.
UNKNOWN = np.sqrt(np.r_[np.full(3, 100.0), np.full(3, 10.0)])
_UNKNOWN_SHARE = 0.1

# Log odds beyond these are certain.
_CERTAIN = 50.0


class Change(str, Enum):
    """Whether something has moved."""

    SAME = "same"
    MOVED = "moved"
    CANNOT_TELL = "cannot tell"

    @classmethod
    def of_all(cls, changes: Sequence["Change"]) -> "Change":
        """The gravest of several."""
        graver = (each for each in (cls.MOVED, cls.CANNOT_TELL) if each in changes)
        return next(graver, cls.SAME)


@dataclass(frozen=True)
class Moved:
    """Which axes differ between two estimates of an extrinsic, and by how much.

    Attributes
    ----------
    values : (6,) array
        Differences along (m) and about (rad) the axes of the parent sensor's frame.
    sigmas : (6,) array
        Their standard deviations; infinite if one of both does not know the axis.
    visible : (6,) array
        Changes of this size would have been seen nine times out of ten.
    verdicts : tuple of Change
        Per axis.
    verdict : Change
    chi2 : float
        Squared distance in units of the covariance; 6 on average if nothing has moved.
    """

    values: FloatArray
    sigmas: FloatArray
    visible: FloatArray
    verdicts: tuple[Change, ...]
    verdict: Change
    chi2: float

    def axes(self, change: Change) -> list[str]:
        """Names of the axes with this verdict."""
        return [axis for axis, found in zip(AXES, self.verdicts, strict=True) if found is change]

    @property
    def sentence(self) -> str:
        """The verdict in one line, with what it rests on."""
        if self.verdict is Change.MOVED:
            return f"moved: {self.what}"
        same, unknown = self.axes(Change.SAME), self.axes(Change.CANNOT_TELL)
        if not unknown:
            return f"same: {self._power(same)}"
        told = f"cannot tell about {listing(unknown)}"
        return f"{told}; {listing(same)} the same: {self._power(same)}" if same else told

    @property
    def what(self) -> str:
        """The axes that have moved; the two that differ most if none has on its own."""
        ratios = np.abs(self.values) / self.sigmas
        most = [AXES[axis] for axis in np.argsort(-ratios)[:2] if ratios[axis] > 0]
        told = [
            f"{axis} by {amount(axis, float(value))} +/- {amount(axis, float(sigma))}"
            for axis in self.axes(Change.MOVED) or most
            for value, sigma in [(self.values[AXES.index(axis)], self.sigmas[AXES.index(axis)])]
        ]
        return listing(told) or "by what the axes show together, none of them alone"

    def _power(self, axes: Sequence[str]) -> str:
        told = []
        for names in (AXES[:3], AXES[3:]):
            known = [axis for axis in names if axis in axes]
            if known:
                worst = max(known, key=lambda axis: float(self.visible[AXES.index(axis)]))
                told.append(amount(worst, float(self.visible[AXES.index(worst)])))
        return f"a change of {' or '.join(told)} would have been seen"


def moved(values: FloatArray, covariance: FloatArray, limits: FloatArray) -> Moved:
    """Judge a difference of two estimates by axis.

    Parameters
    ----------
    values : (6,) array
        Difference along (m) and about (rad) the axes of the parent sensor's frame.
    covariance : (6, 6) array
        Of both estimates together, with the scatter of recordings if they are of two.
    limits : (6,) array
        Changes that have to be seen before an axis is called the same.
    """
    covariance = covariance + 1e-18 * np.eye(6)
    sigmas = np.sqrt(np.diag(covariance))
    chi2 = float(values @ np.linalg.solve(covariance, values))
    sigmas = np.where(sigmas > _UNKNOWN_SHARE * UNKNOWN, np.inf, sigmas)
    visible = (LARGEST_OF_SIX + NINE_TIMES_OUT_OF_TEN) * sigmas
    verdicts = tuple(
        Change.MOVED if ratio > LARGEST_OF_SIX else Change.SAME if seen else Change.CANNOT_TELL
        for ratio, seen in zip(np.abs(values) / sigmas, visible <= limits, strict=True)
    )
    verdict = Change.MOVED if chi2 > CHI2[0.001][6] else Change.of_all(verdicts)
    return Moved(values, sigmas, visible, verdicts, verdict, chi2)


def scatter_of_recordings(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the answers of several recordings of one rig, beside that of one, which
    tells a vehicle from what is held in hand.
    """
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    is_vehicle = variances[2] > _VEHICLE**2 * variances[1]
    return np.diag((_SCATTER_OF_VEHICLE if is_vehicle else _SCATTER_IN_HAND) ** 2)


def shift_covariance(metres: float = SHIFT_M, radians: float = SHIFT_RAD) -> FloatArray:
    """Covariance L (6, 6) of the shifts that are looked for, from standard deviations per axis."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


def log_ratio(H: FloatArray, S: FloatArray, shift: FloatArray | None = None) -> FloatArray:
    """Logarithm of the likelihood ratio of a shift against none.

    Parameters
    ----------
    H : (..., 6, 6) array
        Information since the time from which on the mount may have moved.
    S : (..., 6) array
    shift : (6, 6) array, optional
        L; :func:`shift_covariance` if left out.
    """
    L = shift_covariance() if shift is None else shift
    _, log_volume = np.linalg.slogdet(np.eye(6) + L @ H)
    return 0.5 * (S * solve(H + np.linalg.inv(L), S)).sum(axis=-1) - 0.5 * log_volume


def solve(H: FloatArray, S: FloatArray) -> FloatArray:
    """``H^-1 S`` (..., n) of matrices (..., n, n)."""
    # As many dimensions as the matrices: else NumPy 1 takes the columns for vectors.
    columns = np.broadcast_to(S, H.shape[:-1])[..., None]
    return np.asarray(np.linalg.solve(H, columns)[..., 0])


def most_likely(H: FloatArray, S: FloatArray, ridge: float) -> FloatArray:
    """Shifts (..., 6) that H (..., 6, 6) and S (..., 6) show, with a share ``ridge`` of the
    information of the shifts that are looked for.
    """
    return solve(H + ridge * np.linalg.inv(shift_covariance()), S)


def squared_shift(H: FloatArray, S: FloatArray, ridge: float) -> FloatArray:
    """Squares of these shifts in units of their covariance: ``S' H^-1 S``."""
    return np.asarray((S * most_likely(H, S, ridge)).sum(axis=-1))


def probability(log_ratios: FloatArray, before: float) -> float:
    """Probability of a shift at one of several times, from its logarithmic likelihood ratio at each
    and its probability before that.
    """
    most = log_ratios.max()
    log_odds = most + np.log(np.exp(log_ratios - most).mean() * before / (1.0 - before))
    return float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_CERTAIN, _CERTAIN))))
