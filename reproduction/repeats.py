"""``python -m reproduction repeats``: does the stated standard deviation predict the spread of
independent repeats on real data?

A rig is calibrated from several drives, or from halves and thirds of one. If a stated sigma is
right, the answers of R repeats scatter by it: their sample variance over the mean stated variance
follows chi2(R - 1) / (R - 1). Repeats share
systematic errors (a miscalibrated sensor, scan distortion in every turn); only the comparison with
ground truth, the second table, shows those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.calibration import Calibration, DofVerdict
from hand_eye_calib.engine.offline import calibrate
from reproduction.recordings import PARTS, RecordedSet, Recording, recorded_sets
from reproduction.runner import in_parallel
from reproduction.sources import PublishedSource
from reproduction.writing import markdown_table, write_csv, write_text

if TYPE_CHECKING:
    from reproduction.results import Results

METHODS = {
    "adaptive": {"method": "adaptive"},
    "dnlo auto": {"method": "dnlo", "reference": "auto"},
    "dnlo B10": {"method": "dnlo", "reference": "B10"},
}

# Options of a user who knows neither clock offset nor scale.
_OPTIONS = {"time_offset": "estimate", "scale": "auto"}

# The references among which the error on KITTI is followed.
_OTHER_REFERENCES = ("B1", "B2", "B5", "B10", "B20")

# z-scores above this are explained.
_SUSPICIOUS = 3.0

_CONFIDENCE = 0.95
_KNOWN = (DofVerdict.OBSERVED, DofVerdict.WEAK)
_UNITS = np.r_[np.ones(3), np.full(3, 180.0 / np.pi)]
_UNIT_NAMES = ("m",) * 3 + ("deg",) * 3


@dataclass(frozen=True)
class AxisRatio:
    """Scatter of repeats over their stated standard deviation, on one axis.

    Attributes
    ----------
    dataset, method, axis : str
    spread, sigma : float
        Standard deviation of the answers, and root mean square of the stated ones; m or deg.
    ratio : float
    freedom : int
        Degrees of freedom of the ratio.
    """

    dataset: str
    method: str
    axis: str
    spread: float
    sigma: float
    ratio: float
    freedom: int

    @property
    def is_within_two(self) -> bool:
        """Whether spread and sigma are within a factor of two of each other."""
        return 0.5 <= self.ratio <= 2.0


Truth = dict[str, Any]


def write(name: str, results: Results) -> list[Path]:
    """Calibrate all repeats and write ``NAME.csv``, ``NAME_truth.csv``, ``NAME.md`` and the figure;
    returns their paths.
    """
    assert isinstance(results.source, PublishedSource)
    sets, absent = recorded_sets(Path(results.source.folder).parent)
    tasks = [(found, method) for found in sets for method in METHODS]
    ratios: list[AxisRatio] = sum(in_parallel(_set_ratios, tasks, results.jobs), [])
    truths: list[Truth] = sum(
        in_parallel(
            _against_truth, [task for task in tasks if task[0].truth is not None], results.jobs
        ),
        [],
    )
    text = [
        "# Does the stated sigma predict the spread between repeats?",
        f"Left out, since their folders are absent: {', '.join(absent)}." if absent else "",
        "Standard deviation of the repeats over root mean square of the sigmas stated for them, "
        "per axis of the parent sensor. Repeats are halves and thirds of a drive (together three "
        "degrees of freedom; they are cut from the same drive), or three drives (zxl19: two). If "
        f"every sigma were right, {_CONFIDENCE:.0%} of the ratios would lie within {_band_text(2)} "
        f"(two degrees) or {_band_text(3)} (three).",
        _ratio_table(ratios),
        "All sets and axes together:",
        _pooled_table(ratios),
        "### Against the rectified ground truth of KITTI",
        f"Every axis whose error is above {_SUSPICIOUS:g} sigma, with a reason from the scatter of "
        f"the thirds and from other references (DNLO). {name}_truth.csv has every axis.",
        _truth_table(truths),
    ]
    paths = [
        write_csv(
            results.out / f"{name}.csv", _RATIO_HEADER, [_ratio_row(ratio) for ratio in ratios]
        ),
        write_csv(
            results.out / f"{name}_truth.csv",
            list(truths[0]),
            [list(row.values()) for row in truths],
        )
        if truths
        else None,
        write_text(results.out / f"{name}.md", *text),
        *_draw(results.out / name, ratios),
    ]
    return [path for path in paths if path is not None]


def _draw(stem: Path, ratios: Sequence[AxisRatio]) -> list[Path]:
    # Imported here: the numbers need no Matplotlib.
    from reproduction import repeat_figures

    found: dict[str, dict[str, dict[str, float]]] = {}
    for ratio in ratios:
        found.setdefault(ratio.method, {}).setdefault(ratio.dataset, {})[ratio.axis] = ratio.ratio
    return repeat_figures.draw_ratios(
        "Spread between repeats over stated sigma", found, band(3), stem
    )


def band(freedom: int) -> tuple[float, float]:
    """Range (low, high) that 95 % of the ratios lie in when every stated sigma is right."""
    tail = (1 - _CONFIDENCE) / 2
    low, high = np.sqrt(chi2.ppf((tail, 1 - tail), freedom) / freedom)
    return float(low), float(high)


def _band_text(freedom: int) -> str:
    return "{:.2f} to {:.2f}".format(*band(freedom))


def spread_and_sigma(
    calibrations: Sequence[Calibration],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Variance (6,) of several answers, mean stated variance (6,), and whether all of them observe
    the axis (6,).
    """
    sigmas = np.array([answer.sigmas for answer in calibrations])
    are_known = [[dof.verdict in _KNOWN for dof in answer.observability] for answer in calibrations]
    known: BoolArray = np.logical_and.reduce(are_known)
    deviations = np.array(
        [
            deviation(answer.T_parent_child, calibrations[0].T_parent_child)
            for answer in calibrations
        ]
    )
    stated = np.where(known, (np.where(known, sigmas, 0.0) ** 2).mean(axis=0), np.inf)
    return deviations.var(axis=0, ddof=1), stated, known


def _answer(recording: Recording, found: RecordedSet, method: str, **options: Any) -> Calibration:
    return calibrate(
        recording.parent,
        recording.child,
        **{**_OPTIONS, **found.options, **METHODS[method], **options},
    )


def _groups(found: RecordedSet, method: str) -> list[list[Calibration]]:
    """Lists of answers that repeat each other."""
    if len(found.drives) > 1:
        return [[_answer(drive, found, method) for drive in found.drives]]
    whole = found.drives[0]
    offset_s = _answer(whole, found, method).time_offset_s
    return [
        [_answer(part, found, method) for part in whole.parts(count, offset_s)] for count in PARTS
    ]


def _set_ratios(found: RecordedSet, method: str) -> list[AxisRatio]:
    """AxisRatio of every axis that all repeats of a set observe."""
    groups = [(len(answers) - 1, *spread_and_sigma(answers)) for answers in _groups(found, method)]
    freedom = sum(degrees for degrees, *_ in groups)
    known = np.logical_and.reduce([known for *_, known in groups])
    summed = sum(degrees * spread / stated for degrees, spread, stated, _ in groups)
    squared = np.asarray(summed) / freedom
    spread = np.sqrt(sum(degrees * spread for degrees, spread, _, _ in groups) / freedom) * _UNITS
    with np.errstate(invalid="ignore"):
        sigma = (
            np.sqrt(sum(degrees * stated for degrees, _, stated, _ in groups) / freedom) * _UNITS
        )
    return [
        AxisRatio(
            found.name,
            method,
            axis,
            float(spread[index]),
            float(sigma[index]),
            float(np.sqrt(squared[index])),
            freedom,
        )
        for index, axis in enumerate(AXES)
        if known[index]
    ]


_RATIO_HEADER = [
    "set",
    "method",
    "axis",
    "spread (m or deg)",
    "stated sigma (m or deg)",
    "ratio",
    "degrees of freedom",
    "95 % from",
    "95 % to",
    "within a factor of two",
]


def _ratio_row(ratio: AxisRatio) -> list[object]:
    return [
        ratio.dataset,
        ratio.method,
        ratio.axis,
        ratio.spread,
        ratio.sigma,
        ratio.ratio,
        ratio.freedom,
        *band(ratio.freedom),
        ratio.is_within_two,
    ]


def _ratio_table(ratios: Sequence[AxisRatio]) -> str:
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for ratio in ratios:
        rows.setdefault((ratio.dataset, ratio.method), {})[ratio.axis] = f"{ratio.ratio:.2f}"
    cells = [
        [*names, *(found.get(axis, "not observed") for axis in AXES)]
        for names, found in rows.items()
    ]
    return markdown_table(["set", "method", *AXES], cells)


def _pooled_table(ratios: Sequence[AxisRatio]) -> str:
    rows = []
    for method in METHODS:
        chosen = [ratio for ratio in ratios if ratio.method == method]
        if chosen:
            freedom = sum(ratio.freedom for ratio in chosen)
            pooled = np.sqrt(sum(ratio.freedom * ratio.ratio**2 for ratio in chosen) / freedom)
            above = sum(ratio.ratio > 2 for ratio in chosen)
            below = sum(ratio.ratio < 0.5 for ratio in chosen)
            too_small = sum(chi2.sf(4.0 * ratio.freedom, ratio.freedom) for ratio in chosen)
            too_large = sum(chi2.cdf(0.25 * ratio.freedom, ratio.freedom) for ratio in chosen)
            rows.append(
                [
                    method,
                    len(chosen),
                    f"{pooled:.2f}",
                    f"{np.median([ratio.ratio for ratio in chosen]):.2f}",
                    sum(ratio.is_within_two for ratio in chosen),
                    f"{above} ({too_small:.1f} by chance)",
                    f"{below} ({too_large:.1f} by chance)",
                ]
            )
    header = [
        "method",
        "ratios",
        "pooled ratio",
        "median",
        "within a factor of two",
        "sigma too small by more",
        "too large by more",
    ]
    return markdown_table(header, rows)


def _against_truth(found: RecordedSet, method: str) -> list[Truth]:
    """A dict per axis: error, sigma, z, and possible causes."""
    whole = found.drives[0]
    answer = _answer(whole, found, method)
    as_given = _answer(whole, found, method, time_offset=0.0)
    unscaled = _answer(whole, found, method, scale="none")
    thirds = [_answer(part, found, method) for part in whole.parts(3, answer.time_offset_s)]
    others = [
        _answer(whole, found, "dnlo auto", reference=reference) for reference in _OTHER_REFERENCES
    ]

    assert found.truth is not None
    truth = found.truth

    def errors(answers: Sequence[Calibration]) -> FloatArray:
        return np.array([deviation(one.T_parent_child, truth) * _UNITS for one in answers])

    error, without_offset, without_scale = errors([answer, as_given, unscaled])
    of_thirds, of_others = errors(thirds), errors(others)
    sigma = answer.sigmas * _UNITS
    return [
        {
            "drive": found.name,
            "method": method,
            "axis": axis,
            "unit": unit,
            "error": float(error[k]),
            "sigma": float(sigma[k]),
            "z": float(error[k] / sigma[k]),
            "error, clock as given": float(without_offset[k]),
            "error, scale as given": float(without_scale[k]),
            "scatter of thirds": float(of_thirds[:, k].std(ddof=1)),
            "least error of a reference": float(of_others[:, k].min()),
            "largest error of a reference": float(of_others[:, k].max()),
            "why": _reason(error[k], sigma[k], of_thirds[:, k], of_others[:, k]),
        }
        for k, (axis, unit) in enumerate(zip(AXES, _UNIT_NAMES, strict=True))
    ]


def _reason(error: float, sigma: float, of_thirds: FloatArray, of_others: FloatArray) -> str:
    """Why a z-score is large; empty if it is not."""
    if not abs(error) > _SUSPICIOUS * sigma:
        return ""
    reach = of_others.max() - of_others.min()
    if abs(error) < _SUSPICIOUS * of_thirds.std(ddof=1) / np.sqrt(3):
        return "sigma too small: the scatter of the thirds explains it"
    if (
        abs(error) < _SUSPICIOUS * reach / np.sqrt(len(of_others))
        or of_others.min() * of_others.max() < 0
    ):
        return "depends on the reference: errors correlated for longer than the noise model assumes"
    return (
        "the same in all thirds and with all references: an error of the whole recording or of "
        "the ground truth"
    )


def _truth_table(truths: Sequence[Truth]) -> str:
    header = [
        "drive",
        "method",
        "axis",
        "error",
        "sigma",
        "z",
        "clock as given",
        "scale as given",
        "scatter of thirds",
        "other references",
        "why",
    ]
    rows = [
        [
            row["drive"],
            row["method"],
            f"{row['axis']} ({row['unit']})",
            f"{row['error']:.3f}",
            f"{row['sigma']:.3f}",
            f"{row['z']:.1f}",
            f"{row['error, clock as given']:.3f}",
            f"{row['error, scale as given']:.3f}",
            f"{row['scatter of thirds']:.3f}",
            f"{row['least error of a reference']:.3f} to {row['largest error of a reference']:.3f}",
            row["why"],
        ]
        for row in truths
        if row["why"]
    ]
    return markdown_table(header, rows)
