"""Our errors beside those of KinHEC's solvers: ``python -m reproduction.kinhec --tier small``.

KinHEC (PyPI: ``kinhec``) simulates arms with exact truth. Its eleven solvers are run by its own
protocol: paired rows, the true clock offset, keyframes. Ours gets the same measurements: all rows
of stops, or both streams and the true clock offset. If a camera has no scale, ours estimates it.

The data of a tier are generated in ``--data-folder`` if they are absent: half an hour for
``small``.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kinhec
import numpy as np
import pandas as pd
from kinhec.benchmark import SOLVERS, evaluate_sequence
from kinhec.pipeline import generate_dataset

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.writing import markdown_table, show, study_parser

# Name of our results among those of KinHEC's solvers.
_OURS = "hand_eye_calib"

# Start of KinHEC's clocks (s): our stamps must be positive.
_START_S = 1e6

# Columns of KinHEC's results: errors of X.
_ROTATION = "X_rot_err_deg"
_TRANSLATION = "X_trans_err_mm"


@dataclass(frozen=True)
class Score:
    """Result of ours for one sequence: errors, and the share of axes that its intervals cover."""

    rotation_deg: float
    translation_mm: float
    covered: float


def data_of(folder: Path, tier: str) -> Path:
    """Return the folder of a tier's data, which are generated if they are absent."""
    path = folder / f"kinhec-{tier}"
    if not (path / "sequences.csv").exists():
        generate_dataset(tier, path, work_dir=path / "work", write_card=False)
    return path


def solve_ours(sequence: Any) -> hec.Calibration:
    """Calibrate a sequence as a user would who knows its clock offset."""
    options: dict[str, Any] = {}
    if sequence.manifest["track"] == "monocular" or sequence.scale != 1.0:
        options["scale"] = "estimate"
    if sequence.manifest["sampling_mode"] == "stations":
        robot, camera = sequence.axyb_poses()
        return hec.calibrate_stops(
            robot, camera, hec.CalibratorConfig(**options)
        )
    is_measured = sequence.camera.has_measurement
    camera = sequence.camera.T_cam_target_meas[is_measured]
    if sequence.eye_in_hand:
        camera = se3.inverse(camera)
    parent = _trajectory(sequence.robot.t, sequence.robot.T_base_ee_meas)
    child = _trajectory(sequence.camera.t[is_measured], camera)
    return hec.calibrate(
        parent, child, time_offset=-sequence.time_offset, **options
    )


def _trajectory(seconds: FloatArray, poses: FloatArray) -> hec.Trajectory:
    stamps_ns = np.round((_START_S + seconds) * 1e9)
    return hec.Trajectory(stamps_ns.astype(np.int64), poses)


def score(result: hec.Calibration, truth: FloatArray) -> Score:
    """Return errors of a result as KinHEC defines them, and the covered share of the six axes."""
    errors = se3.deviation(result.T_parent_child, truth)
    metres = np.linalg.norm(errors[:3])
    radians = np.linalg.norm(errors[3:])
    is_covered = np.abs(errors) < HALF_WIDTH_90 * result.sigmas_measured
    return Score(
        rotation_deg=float(np.degrees(radians)),
        translation_mm=1e3 * float(metres),
        covered=float(is_covered.mean()),
    )


def results_of(data: Path) -> pd.DataFrame:
    """Return a row for each sequence and solver, ours included."""
    rows = []
    for number, sequence in enumerate(kinhec.io.iter_sequences(data)):
        rng = np.random.default_rng(number)
        theirs = evaluate_sequence(sequence, list(SOLVERS), rng=rng)
        try:
            ours = score(solve_ours(sequence), sequence.X)
        except hec.HandEyeCalibError as error:
            print(f"{sequence.id}: {error}")
            continue
        shared = {
            name: sequence.manifest[name] for name in ("sequence_id", "track")
        }
        shared["kind"] = "stops"
        if sequence.manifest["sampling_mode"] != "stations":
            shared["kind"] = "continuous"
        rows += [{**row, **shared} for row in theirs]
        own = {
            "solver": _OURS,
            "ok": True,
            _ROTATION: ours.rotation_deg,
            _TRANSLATION: ours.translation_mm,
            "covered": ours.covered,
        }
        rows.append({**own, **shared})
    return pd.DataFrame(rows)


def table(results: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield a row for each kind of recording and track: ours and the best of KinHEC's solvers.

    A solver of KinHEC that fails on a sequence of a track is left out of the track.
    """
    for (kind, track), rows in results.groupby(["kind", "track"]):
        is_ours = rows["solver"] == _OURS
        ours = rows[is_ours]
        has_answers = rows.groupby("solver")["ok"].transform("all")
        theirs = rows[~is_ours & has_answers].groupby("solver")
        line = {"recordings": f"{kind}, {track}", "sequences": str(len(ours))}
        for title, column in (("deg", _ROTATION), ("mm", _TRANSLATION)):
            own_errors = ours[column]
            errors = theirs[column]
            means = _beside(own_errors.mean(), errors.mean())
            quantiles = _beside(own_errors.quantile(0.9), errors.quantile(0.9))
            line[f"mean, {title}"] = means
            line[f"90 % quantile, {title}"] = quantiles
        covered = ours["covered"].mean()
        line["90 % intervals cover"] = f"{covered:.0%}"
        yield line


def _beside(error: float, errors_of_solvers: pd.Series) -> str:
    """Return our error and the smallest of KinHEC's solvers as text; ours is bold if first."""
    best = errors_of_solvers.min()
    solver = errors_of_solvers.idxmin()
    own_text = f"{error:.3f}"
    if error <= best:
        own_text = f"**{own_text}**"
    return f"{own_text} / {best:.3f} {solver}"


def page(data: Path, tier: str, results: pd.DataFrame) -> str:
    """Return the table of a tier as Markdown, with the version of KinHEC and the data's digest."""
    content = (data / "sequences.csv").read_bytes()
    digest = hashlib.sha256(content).hexdigest()[:12]
    text = (
        f"Tier `{tier}` of KinHEC {kinhec.__version__} (sequences.csv {digest}), "
        f"`python -m reproduction.kinhec --tier {tier}`. Cells: ours / the best of its solvers."
    )
    return f"{text}\n\n{markdown_table(table(results))}"


def main() -> None:
    """Solve all sequences of a tier, and print the table or put it into the page."""
    parser = study_parser("reproduction.kinhec", __doc__)
    parser.add_argument(
        "--tier", default="small", help="smoke, small, ...; default: small"
    )
    arguments = parser.parse_args()
    folder = arguments.data_folder or parser.error(
        "name a folder for the data: --data-folder"
    )
    data = data_of(folder, arguments.tier)
    text = page(data, arguments.tier, results_of(data))
    show(arguments.page, {f"kinhec-{arguments.tier}": text})


if __name__ == "__main__":
    main()
