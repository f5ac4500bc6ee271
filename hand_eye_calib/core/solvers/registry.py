"""Solvers of AX = XB by the names of their methods, and a method with its options."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig, require_backend
from hand_eye_calib.core.base.errors import ConfigError, NotEnoughDataError
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import (
    all_pairs,
    certificate,
    dnlo,
    quadratic_form,
    robust,
    zhuang,
)
from hand_eye_calib.core.solvers.all_pairs import Solution


class _Solver(NamedTuple):
    """Functions of a method.

    Attributes
    ----------
    solve : callable
        ``solve(pairs)``; for dnlo ``solve(pairs, threshold, min_inlier_fraction)``.
    solve_near : callable or None
        Function ``solve_near(pairs, T_start)`` that starts from a transform (4, 4) near the
        solution, which saves time. None if the method needs no start.
    solve_best_stride : callable or None
        Function ``solve_best_stride(Ts_pw_p, Ts_cw_c)`` that chooses the motions for the reference
        ``auto``, and solves them. None if the adaptive estimator chooses the reference.
    """

    solve: Callable[..., Solution]
    solve_near: Callable[..., Solution] | None = None
    solve_best_stride: (
        Callable[[FloatArray, FloatArray], robust.Stride] | None
    ) = None


# Taylor's method has the same solution as Park's.
_SOLVERS = {
    "dnlo": _Solver(dnlo.solve),
    "dnl": _Solver(all_pairs.solve_dnl),
    "park": _Solver(all_pairs.solve_park),
    "taylor": _Solver(all_pairs.solve_park),
    "zhuang": _Solver(zhuang.solve),
    "ali": _Solver(all_pairs.solve_ali),
    "robust": _Solver(robust.solve, robust.solve, robust.solve_best_stride),
}


@dataclass(frozen=True)
class Method:
    """Method of the paper, or robust least squares, with its options.

    Parameters
    ----------
    name : str
        A method of :data:`hand_eye_calib.core.base.config.METHODS` that uses a reference.
    threshold : float
        c of eq. (5), in m^2; only for dnlo.
    min_inlier_fraction : float
        d of eq. (5), divided by the number of pairs; only for dnlo.
    backend : str
        "fast", or "ipopt" for dnl and dnlo.

    Raises
    ------
    ConfigError
        If the method is unknown or lacks the backend.
    """

    name: str
    threshold: float = CalibratorConfig.threshold
    min_inlier_fraction: float = CalibratorConfig.min_inlier_fraction
    backend: str = CalibratorConfig.backend

    def __post_init__(self) -> None:
        if self.name not in _SOLVERS:
            raise ConfigError(
                f"method {self.name!r} is unknown; known are {', '.join(_SOLVERS)}"
            )
        require_backend(self.name, self.backend)

    @property
    def solve_best_stride(
        self,
    ) -> Callable[[FloatArray, FloatArray], robust.Stride] | None:
        """Function ``(Ts_pw_p, Ts_cw_c)`` that chooses the motions for the reference ``auto``.

        The value is None if the method has no such function.
        """
        return _SOLVERS[self.name].solve_best_stride

    def solve(self, pairs: MotionPairs) -> Solution:
        """Solve AX = XB.

        Raises
        ------
        NotEnoughDataError
            If the pairs are empty.
        """
        if len(pairs) == 0:
            raise NotEnoughDataError(
                "no motion pairs: there are too few common poses for the chosen reference; record "
                "longer, or choose a reference over fewer poses, such as B1"
            )
        solve = _SOLVERS[self.name].solve
        if self.backend == "ipopt":
            # The import takes a second, so it is only here.
            from hand_eye_calib.core.solvers import ipopt

            solve = ipopt.solve_dnl if self.name == "dnl" else ipopt.solve_dnlo
        if self.name == "dnlo":
            return solve(pairs, self.threshold, self.min_inlier_fraction)
        return solve(pairs)

    def proved_global(self, pairs: MotionPairs, solution: Solution) -> str:
        """Return whether a solution is proved to be the global minimum over its inliers.

        The result is "yes", "no", or "not tried" for methods without a proof.
        """
        if self.name not in ("dnl", "dnlo"):
            return "not tried"
        Q = quadratic_form.weighted_sum(
            quadratic_form.coefficients(pairs), solution.weights
        )
        return (
            "yes" if certificate.is_global(Q, solution.T_parent_child) else "no"
        )

    def solve_without(
        self, pairs: MotionPairs, solution: Solution, left_out: BoolArray
    ) -> FloatArray:
        """Solve B times, each time without some pairs, for resampling.

        Parameters
        ----------
        pairs : MotionPairs
            K pairs.
        solution : Solution
            Solution with all pairs.
        left_out : (B, K) bool array
            Pairs that are omitted in each solution.

        Returns
        -------
        (B, 4, 4) array
            Transforms X.
        """
        if self.name == "dnlo":
            # Iterations from the solution are faster than a new search.
            return dnlo.solve_without(
                pairs,
                solution,
                left_out,
                self.threshold,
                self.min_inlier_fraction,
            )
        solve = self.solve
        if solve_near := _SOLVERS[self.name].solve_near:
            solve = partial(solve_near, T_start=solution.T_parent_child)
        return np.stack([solve(pairs[~row]).T_parent_child for row in left_out])
