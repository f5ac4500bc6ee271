"""Counts of a study of faults: verdicts, findings, and errors of results that are not refused."""

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.reasons import Verdict
from hand_eye_calib.core.results.records import Severity
from reproduction.writing import counted

# A result is wrong if the error of an axis exceeds this number of its standard deviations.
FAR_SIGMAS = 3.3


@dataclass
class Tally:
    """Counts of the results of recordings with one fault.

    ``n_named`` counts results with a finding that names the fault, ``n_with_findings`` results with
    any finding, and ``n_far`` results with the verdict USE that are wrong. ``largest_ratio`` is the
    largest error in standard deviations of results that are not DO NOT USE.
    """

    verdicts: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    n_named: int = 0
    n_with_findings: int = 0
    n_far: int = 0
    largest_ratio: float = 0.0

    def add(self, result: Calibration, ratio: float, names: Set[str]) -> None:
        """Count a result.

        ``ratio`` is the largest error of the result in standard deviations. Findings with a code in
        ``names`` name the fault.
        """
        self.verdicts[result.verdict.value] += 1
        codes = set()
        for finding in result.findings:
            if finding.severity is not Severity.NOTE:
                codes.add(finding.code)
        self.codes.update(codes)
        self.n_named += not codes.isdisjoint(names)
        self.n_with_findings += bool(codes)
        if result.verdict is not Verdict.DO_NOT_USE:
            self.largest_ratio = max(self.largest_ratio, ratio)
        if result.verdict is Verdict.USE:
            self.n_far += ratio > FAR_SIGMAS

    def verdict_cells(self) -> dict[str, object]:
        """Return the cells of a row about verdicts."""
        return {"Verdicts": counted(self.verdicts.elements())}

    def error_cells(self) -> dict[str, object]:
        """Return the cells of a row about errors of results that are not refused."""
        return {
            "USE beyond 3.3 sigma": self.n_far,
            "Largest z that is not DO NOT USE": f"{self.largest_ratio:.1f}",
        }


def largest_ratio(errors: FloatArray, sigmas: FloatArray) -> float:
    """Return the largest ratio of an error to its standard deviation over the known axes."""
    is_known = np.isfinite(sigmas)
    ratios = errors[is_known] / sigmas[is_known]
    return float(np.abs(ratios).max(initial=0.0))
