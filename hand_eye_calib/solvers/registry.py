"""The solvers of AX = XB by the name of their method, with the options they take."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, NotEnoughDataError
from hand_eye_calib.methods import METHODS, MethodRecord
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers import ali, certificate, dnl, dnlo, park, zhuang
from hand_eye_calib.solvers.solution import Solution

# ``solve(pairs, *rejection)``; for rejection see Method.rejection.
_SOLVE: dict[str, Callable[..., Solution]] = {
    "dnlo": dnlo.solve,
    "dnl": dnl.solve,
    "park": park.solve,
    "taylor": park.solve,
    "zhuang": zhuang.solve,
    "ali": ali.solve,
}

# ``solve_without(pairs, solution, left_out, *rejection)`` of the methods that are quicker from a
# solution than from nothing.
_SOLVE_WITHOUT: dict[str, Callable[..., FloatArray]] = {
    "dnlo": dnlo.solve_without,
    "dnl": dnl.solve_without,
}

# ``solve_from(pairs, T_parent_child, *rejection)`` of the methods whose cost is the quadratic form,
# over the pairs that count.
_SOLVE_FROM: dict[str, Callable[..., Solution]] = {
    "dnlo": dnlo.solve_from,
    "dnl": dnl.solve_from,
}


@dataclass(frozen=True)
class Method:
    """A method with its options set.

    Parameters
    ----------
    name : str
        Name of a method in :data:`hand_eye_calib.methods.METHODS` that uses a reference.
    threshold : float
        c of eq. (5), in m^2. Only dnlo uses it.
    min_inlier_fraction : float
        d of eq. (5) over the number of pairs. Only dnlo uses it.
    backend : str
        "fast", or "ipopt" for dnl and dnlo.

    Raises
    ------
    ConfigError
        If the method is unknown or does not have the backend.
    """

    name: str
    threshold: float = CalibratorConfig.threshold
    min_inlier_fraction: float = CalibratorConfig.min_inlier_fraction
    backend: str = CalibratorConfig.backend

    def __post_init__(self) -> None:
        if self.name not in _SOLVE:
            raise ConfigError(f"method {self.name!r} is unknown; known are {', '.join(_SOLVE)}")
        self.record.require_backend(self.backend)

    @property
    def record(self) -> MethodRecord:
        """Properties of the method."""
        return METHODS[self.name]

    @property
    def rejection(self) -> tuple[float, ...]:
        """``threshold`` and ``min_inlier_fraction``; empty if the method rejects no outliers."""
        return (self.threshold, self.min_inlier_fraction) if self.record.rejects_outliers else ()

    def solve(self, pairs: MotionPairs) -> Solution:
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
            If there is no pair.
        """
        if len(pairs) == 0:
            raise NotEnoughDataError(
                "no motion pairs: there are too few common poses for the chosen reference"
            )
        solve = _SOLVE[self.name] if self.backend == "fast" else _ipopt_solve(self.name)
        return solve(pairs, *self.rejection)

    def prove(self, pairs: MotionPairs, solution: Solution) -> Solution:
        """Prove that a solution is the global minimum over the pairs it counts.

        Parameters
        ----------
        pairs : MotionPairs
        solution : Solution
            Of these pairs.

        Returns
        -------
        Solution
            With ``is_proved_global``, which stays None for methods that have no proof. A better one
            if the search that follows a failed proof finds it.
        """
        if self.name not in _SOLVE_FROM:
            return solution

        def solve_from(T_parent_child: FloatArray) -> Solution:
            return _SOLVE_FROM[self.name](pairs, T_parent_child, *self.rejection)

        return certificate.prove(pairs, solution, solve_from)

    def solve_without(
        self, pairs: MotionPairs, solution: Solution, left_out: BoolArray
    ) -> FloatArray:
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
        if self.name in _SOLVE_WITHOUT:
            return _SOLVE_WITHOUT[self.name](pairs, solution, left_out, *self.rejection)
        return np.stack([self.solve(pairs[~row]).T_parent_child for row in left_out])


def _ipopt_solve(name: str) -> Callable[..., Solution]:
    """The solver of a method with CasADi and Ipopt, which take a second to import."""
    from hand_eye_calib.solvers import ipopt

    solvers: dict[str, Callable[..., Solution]] = {
        "dnl": ipopt.solve_dnl,
        "dnlo": ipopt.solve_dnlo,
    }
    return solvers[name]
