"""``python -m reproduction repeats``: does the stated standard deviation predict the spread of
independent repeats on real data?

A rig is calibrated from several drives, or from halves and thirds of one. If a stated sigma is
right, the answers of R repeats scatter by it: their sample variance over the mean stated variance
follows chi2(R - 1) / (R - 1). Repeats share
systematic errors (a miscalibrated sensor, scan distortion in every turn); only the comparison with
ground truth, the second table, shows those.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.results.calibration import Calibration, DofVerdict
from reproduction.recordings import PARTS, Recording, Rig, real_rigs
from reproduction.results import Results
from reproduction.runner import in_parallel
from reproduction.sources import PublishedSource
from reproduction.writing import markdown_table, write_csv, write_text

METHODS = {
    "adaptive": {"method": "adaptive"},
    "dnlo auto": {"method": "dnlo", "reference": "auto"},
    "dnlo B10": {"method": "dnlo", "reference": "B10"},
}

# Rigs and their names here.
_SETS = {
    "kitti_short": "kitti_short",
    "kitti_long": "kitti_long",
    "zxl19_lidar": "zxl19",
    "tango_caligula_mars": "tango C<-M",
    "tango_mars_nero": "tango M<-N",
    "tango_nero_caligula": "tango N<-C",
}
_FOLDERS = ("valimaki2023", "zxl19", "asl_tango_easy")

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
    """Scatter of repeats over their stated standard deviation, on one axis."""

    dataset: str
    method: str
    axis: str
    # Standard deviation of the answers, and root mean square of the stated ones; m or deg.
    spread: float
    sigma: float
    ratio: float
    # Degrees of freedom of the ratio.
    freedom: int

    @property
    def is_within_two(self) -> bool:
        """Whether spread and sigma are within a factor of two of each other."""
        return 0.5 <= self.ratio <= 2.0


Truth = dict[str, Any]


def recorded_sets(folder: Path) -> tuple[dict[str, Rig], list[str]]:
    """The rigs of this study whose files are there, by name, and the folders that are not."""
    rigs, absent = real_rigs(folder)
    sets = {_SETS[rig.name]: rig for rig in rigs if rig.name in _SETS}
    return sets, [name for name in _FOLDERS if name in absent]


def write(name: str, results: Results) -> list[Path]:
    """Calibrate all repeats and write ``NAME.csv``, ``NAME_truth.csv``, ``NAME.md`` and the figure;
    returns their paths.
    """
    from reproduction import paper_figures

    assert isinstance(results.source, PublishedSource)
    sets, absent = recorded_sets(Path(results.source.folder).parent)
    tasks = [(dataset, rig, method) for dataset, rig in sets.items() for method in METHODS]
    ratios: list[AxisRatio] = sum(in_parallel(axis_ratios, tasks, results.jobs), [])
    on_kitti = [task for task in tasks if task[0].startswith("kitti")]
    truths: list[Truth] = sum(in_parallel(_against_truth, on_kitti, results.jobs), [])
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
        markdown_table(_printed(row) for row in truths if row["why"]),
    ]
    by_axis: dict[str, dict[str, dict[str, float]]] = {}
    for ratio in ratios:
        of_method = by_axis.setdefault(ratio.method, {})
        of_method.setdefault(ratio.dataset, {})[ratio.axis] = ratio.ratio
    return [
        write_csv(results.out / f"{name}.csv", map(_ratio_row, ratios)),
        *([write_csv(results.out / f"{name}_truth.csv", truths)] if truths else []),
        write_text(results.out / f"{name}.md", *text),
        *paper_figures.draw_ratios(
            "Spread between repeats over stated sigma", by_axis, band(3), results.out / name
        ),
    ]


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
    first = calibrations[0].T_parent_child
    deviations = np.array([deviation(answer.T_parent_child, first) for answer in calibrations])
    stated = np.where(known, (np.where(known, sigmas, 0.0) ** 2).mean(axis=0), np.inf)
    return deviations.var(axis=0, ddof=1), stated, known


def _answer(recording: Recording, rig: Rig, method: str, **options: Any) -> Calibration:
    options = {**rig.options, **METHODS[method], **options}
    return calibrate(recording.parent, recording.child, **options)


def _groups(rig: Rig, method: str) -> list[list[Calibration]]:
    """Lists of answers that repeat each other."""
    whole, *others = rig.recordings.values()
    if others:
        return [[_answer(drive, rig, method) for drive in (whole, *others)]]
    offset_s = _answer(whole, rig, method).time_offset_s
    return [
        [_answer(part, rig, method) for part in whole.parts(count, offset_s)] for count in PARTS
    ]


def axis_ratios(dataset: str, rig: Rig, method: str) -> list[AxisRatio]:
    """AxisRatio of every axis that all repeats of a rig observe."""
    groups = [(len(answers) - 1, *spread_and_sigma(answers)) for answers in _groups(rig, method)]
    freedom = sum(degrees for degrees, *_ in groups)
    known = np.logical_and.reduce([known for *_, known in groups])
    with np.errstate(invalid="ignore"):
        squared, spread, sigma = (
            np.asarray(sum(degrees * values for degrees, values in terms)) / freedom
            for terms in (
                [(degrees, spread / stated) for degrees, spread, stated, _ in groups],
                [(degrees, spread) for degrees, spread, _, _ in groups],
                [(degrees, stated) for degrees, _, stated, _ in groups],
            )
        )
    found = []
    for k in np.flatnonzero(known):
        spread_k, sigma_k = (float(np.sqrt(each[k]) * _UNITS[k]) for each in (spread, sigma))
        ratio = float(np.sqrt(squared[k]))
        found.append(AxisRatio(dataset, method, AXES[k], spread_k, sigma_k, ratio, freedom))
    return found


def _ratio_row(ratio: AxisRatio) -> dict[str, object]:
    low, high = band(ratio.freedom)
    return {
        "set": ratio.dataset,
        "method": ratio.method,
        "axis": ratio.axis,
        "spread (m or deg)": ratio.spread,
        "stated sigma (m or deg)": ratio.sigma,
        "ratio": ratio.ratio,
        "degrees of freedom": ratio.freedom,
        "95 % from": low,
        "95 % to": high,
        "within a factor of two": ratio.is_within_two,
    }


def _ratio_table(ratios: Sequence[AxisRatio]) -> str:
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for ratio in ratios:
        row = {"set": ratio.dataset, "method": ratio.method, **dict.fromkeys(AXES, "not observed")}
        rows.setdefault((ratio.dataset, ratio.method), row)[ratio.axis] = f"{ratio.ratio:.2f}"
    return markdown_table(rows.values())


def _pooled_table(ratios: Sequence[AxisRatio]) -> str:
    rows = []
    for method in METHODS:
        chosen = [ratio for ratio in ratios if ratio.method == method]
        if not chosen:
            continue
        freedom = sum(ratio.freedom for ratio in chosen)
        pooled = np.sqrt(sum(ratio.freedom * ratio.ratio**2 for ratio in chosen) / freedom)
        above = sum(ratio.ratio > 2 for ratio in chosen)
        below = sum(ratio.ratio < 0.5 for ratio in chosen)
        too_small = sum(chi2.sf(4.0 * ratio.freedom, ratio.freedom) for ratio in chosen)
        too_large = sum(chi2.cdf(0.25 * ratio.freedom, ratio.freedom) for ratio in chosen)
        rows.append(
            {
                "method": method,
                "ratios": len(chosen),
                "pooled ratio": f"{pooled:.2f}",
                "median": f"{np.median([ratio.ratio for ratio in chosen]):.2f}",
                "within a factor of two": sum(ratio.is_within_two for ratio in chosen),
                "sigma too small by more": f"{above} ({too_small:.1f} by chance)",
                "too large by more": f"{below} ({too_large:.1f} by chance)",
            }
        )
    return markdown_table(rows)


def _against_truth(dataset: str, rig: Rig, method: str) -> list[Truth]:
    """A dict per axis: error, sigma, z, and possible causes."""
    (whole,) = rig.recordings.values()
    answer = _answer(whole, rig, method)
    as_given = _answer(whole, rig, method, time_offset=0.0)
    unscaled = _answer(whole, rig, method, scale="none")
    thirds = [_answer(part, rig, method) for part in whole.parts(3, answer.time_offset_s)]
    others = [_answer(whole, rig, "dnlo auto", reference=name) for name in _OTHER_REFERENCES]

    assert rig.truth is not None
    truth = rig.truth.T_parent_child

    def errors(answers: Sequence[Calibration]) -> FloatArray:
        return np.array([deviation(one.T_parent_child, truth) * _UNITS for one in answers])

    error, without_offset, without_scale = errors([answer, as_given, unscaled])
    of_thirds, of_others = errors(thirds), errors(others)
    sigma = answer.sigmas * _UNITS
    return [
        {
            "drive": dataset,
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
            "why": reason(error[k], sigma[k], of_thirds[:, k], of_others[:, k]),
        }
        for k, (axis, unit) in enumerate(zip(AXES, _UNIT_NAMES, strict=True))
    ]


def reason(error: float, sigma: float, of_thirds: FloatArray, of_others: FloatArray) -> str:
    """Why a z-score is large; empty if it is not."""
    if not abs(error) > _SUSPICIOUS * sigma:
        return ""
    if abs(error) < _SUSPICIOUS * of_thirds.std(ddof=1) / np.sqrt(3):
        return "sigma too small: the scatter of the thirds explains it"
    reach = of_others.max() - of_others.min()
    is_within = abs(error) < _SUSPICIOUS * reach / np.sqrt(len(of_others))
    if is_within or of_others.min() * of_others.max() < 0:
        return "depends on the reference: errors correlated for longer than the noise model assumes"
    return (
        "the same in all thirds and with all references: an error of the whole recording or of "
        "the ground truth"
    )


def _printed(row: Truth) -> dict[str, str]:
    least, largest = row["least error of a reference"], row["largest error of a reference"]
    return {
        "drive": row["drive"],
        "method": row["method"],
        "axis": f"{row['axis']} ({row['unit']})",
        "error": f"{row['error']:.3f}",
        "sigma": f"{row['sigma']:.3f}",
        "z": f"{row['z']:.1f}",
        "clock as given": f"{row['error, clock as given']:.3f}",
        "scale as given": f"{row['error, scale as given']:.3f}",
        "scatter of thirds": f"{row['scatter of thirds']:.3f}",
        "other references": f"{least:.3f} to {largest:.3f}",
        "why": row["why"],
    }
