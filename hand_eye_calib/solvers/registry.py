"""All methods by name: the one place that knows which solver takes which option."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.errors import ConfigError, NotEnoughDataError
from hand_eye_calib.solvers import ali, dnl, dnlo, park, taylor, zhuang

_PLAIN = {"park": park, "taylor": taylor, "zhuang": zhuang, "ali": ali}


@dataclass(frozen=True)
class Method:
    """A method with its options set.

    Parameters
    ----------
    name : str
        A name in :data:`hand_eye_calib.config.METHODS`.
    threshold : float
        dnlo only: c of eq. (5), in m^2.
    min_inlier_fraction : float
        dnlo only: d of eq. (5) as a share of the pairs.
    backend : str
        dnl and dnlo only: "fast" or "ipopt".

    Raises
    ------
    ConfigError
        For an unknown method, or a backend that the method does not have.
    """

    name: str
    threshold: float = 0.01
    min_inlier_fraction: float = 0.5
    backend: str = "fast"

    def __post_init__(self):
        if self.name not in ("dnl", "dnlo", *_PLAIN):
            raise ConfigError(
                f"method {self.name!r} is unknown; known are dnlo, dnl, {', '.join(_PLAIN)}"
            )
        if self.backend == "ipopt" and self.name in _PLAIN:
            raise ConfigError(f"method {self.name} has no ipopt backend; only dnl and dnlo do")

    def solve(self, pairs):
        """Solve AX = XB.

        Parameters
        ----------
        pairs : MotionPairs

        Returns
        -------
        Solution

        Raises
        ------
        NotEnoughDataError
            Without any pair.
        """
        if len(pairs) == 0:
            raise NotEnoughDataError(
                "no motion pairs: there are too few common poses for the chosen reference"
            )
        if self.backend == "ipopt":
            from hand_eye_calib.solvers import ipopt

            return (
                ipopt.solve_dnl(pairs)
                if self.name == "dnl"
                else ipopt.solve_dnlo(pairs, *self._rejection)
            )
        if self.name == "dnlo":
            return dnlo.solve(pairs, *self._rejection)
        return dnl.solve(pairs) if self.name == "dnl" else _PLAIN[self.name].solve(pairs)

    def solve_without(self, pairs, solution, left_out):
        """Answers near a solution when some pairs are left out, for resampling.

        Parameters
        ----------
        pairs : MotionPairs
            K pairs.
        solution : Solution
            The solution for all of them.
        left_out : (B, K) bool array

        Returns
        -------
        (B, 4, 4) array
        """
        if self.name == "dnlo":
            return dnlo.solve_without(pairs, solution, left_out, *self._rejection)
        if self.name == "dnl":
            return dnl.solve_without(pairs, solution, left_out)
        return np.stack([self.solve(pairs[~row]).T_parent_child for row in left_out])

    @property
    def _rejection(self):
        return self.threshold, self.min_inlier_fraction


def solve(method, pairs, **options):
    """``Method(method, **options).solve(pairs)``, for a single solve."""
    return Method(method, **options).solve(pairs)
