"""``python -m reproduction.floor --data-folder DIR``: test the sizes of the common-mode floor.

The common-mode floor is the part of sigma for errors that are the same in every recording. For each
family of real recordings, the sizes of the floor are chosen by likelihood on all other families,
with equal weights. The coverage of the 90 % intervals is then measured on the family itself. Pieces
of recordings are drawn anew at every run.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
import pandas as pd

from hand_eye_calib.core.assessment.common_mode import (
    common_mode_floor,
    usual_speed,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.se3 import deviation
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.coverage.scores import answer
from reproduction.gate.cases import Case, real_cases
from reproduction.writing import markdown_table, seed_of, show, study_parser

# Errors in standard deviations are limited to this value, so that an outlier does not decide.
_FARTHEST = 3.0

# Sizes to choose from: translation (m), rotation (rad), and translation per speed (s).
_SIZES = (
    (0.001, 0.003, 0.005, 0.01),
    np.radians((0.05, 0.1, 0.15, 0.2)),
    (0.0, 0.0025, 0.005, 0.0075, 0.01),
)


def axes(case: Case) -> Iterator[dict[str, object]]:
    """Yield the error and the variances of each axis that the truth and the motion determine.

    The variances are: ``truth`` of the true value, ``stated`` without the floor, ``whole`` with the
    floor, and ``rest`` of floor terms that do not depend on its sizes.
    """
    parent = case.streams[0]
    result = answer(*case.streams, case.options)
    if result is None:
        return
    speed_m_s = usual_speed(parent.stamps_ns, parent.poses[:, :3, 3])
    floor = np.diag(common_mode_floor(speed_m_s))
    stated = result.sigmas_measured**2
    whole = result.sigmas**2
    error = deviation(result.T_parent_child, case.T_parent_child)
    for k in np.flatnonzero(np.isfinite(stated) & np.isfinite(case.sigmas)):
        rest = whole[k] - stated[k] - floor[k]
        yield {
            "family": case.family,
            "turns": k > 2,
            "speed": speed_m_s,
            "error": error[k],
            "truth": case.sigmas[k] ** 2,
            "stated": stated[k],
            "whole": whole[k],
            "rest": max(rest, 0.0),
        }


def _variances(
    axis_rows: pd.DataFrame, sizes: tuple[float, float, float]
) -> FloatArray:
    """Return the variances of the axes with a floor of these sizes (m, rad, s)."""
    translation, rotation, travel_s = sizes
    of_speed = translation**2 + (travel_s * axis_rows["speed"]) ** 2
    fixed = np.where(axis_rows["turns"], rotation**2, of_speed)
    return np.asarray(axis_rows["stated"] + axis_rows["rest"] + fixed)


def chosen(axis_rows: pd.DataFrame) -> tuple[float, float, float]:
    """Return the most likely sizes of the floor, among :data:`_SIZES`.

    The loss is the negative log likelihood of normal errors, as a mean over families.
    """

    def loss(sizes: tuple[float, float, float]) -> float:
        variances = _variances(axis_rows, sizes) + axis_rows["truth"]
        squares = axis_rows["error"] ** 2 / variances
        losses = np.log(variances) + np.minimum(squares, _FARTHEST**2)
        of_families = losses.groupby(axis_rows["family"]).mean()
        return float(of_families.mean())

    return min(product(*_SIZES), key=loss)


def _row(
    name: str, axis_rows: pd.DataFrame, sizes: str = ""
) -> dict[str, object]:
    """Return the row of a family; coverage is with and without the variance of the truth."""
    absolute = np.abs(axis_rows["error"])
    truth = axis_rows["truth"]
    row: dict[str, object] = {
        "Family": name,
        "Axes": len(axis_rows),
        "Chosen without it": sizes,
    }
    columns = {
        "Covers then": "then",
        "As it is": "whole",
        "No floor": "stated",
    }
    for title, column in columns.items():
        variances = axis_rows[column]
        with_truth = absolute < HALF_WIDTH_90 * np.sqrt(variances + truth)
        without_truth = absolute < HALF_WIDTH_90 * np.sqrt(variances)
        row[title] = (
            f"{100 * np.mean(with_truth):.0f} %, {100 * np.mean(without_truth):.0f} %"
        )
    floor_sigmas = np.sqrt(axis_rows["whole"] - axis_rows["stated"])
    floor = floor_sigmas[~axis_rows["turns"]]
    largest = (absolute / np.sqrt(axis_rows["whole"] + truth)).max()
    return row | {
        "Mean floor (mm)": f"{1e3 * floor.mean():.1f}",
        "Largest z": f"{largest:.1f}",
    }


def table(axis_rows: pd.DataFrame) -> str:
    """Return a table with a row for each family and a last row for all families.

    Column ``then`` of the rows gets the variances with the floor chosen on the other families.
    """
    rows = []
    for family in axis_rows["family"].unique():
        is_left_out = axis_rows["family"] == family
        sizes = chosen(axis_rows[~is_left_out])
        metres, radians, travel_s = sizes
        axis_rows.loc[is_left_out, "then"] = _variances(
            axis_rows[is_left_out], sizes
        )
        words = f"{1e3 * metres:g} mm, {np.degrees(radians):.2f} deg, {1e3 * travel_s:g} ms"
        rows.append(_row(family, axis_rows[is_left_out], words))
    return markdown_table([*rows, _row("all", axis_rows)])


def main() -> None:
    """Draw pieces of recordings, calibrate them, and print the table."""
    parser = study_parser("reproduction.floor", __doc__)
    parser.add_argument(
        "--pieces",
        type=int,
        default=6,
        help="pieces of each recording. Default: 6",
    )
    arguments = parser.parse_args()
    folder = arguments.data_folder or parser.error(
        "name the recordings with --data-folder"
    )
    seed = seed_of(None)
    option_names = ("time_offset", "scale", "prior")
    rng = np.random.default_rng(seed)
    cases = real_cases(folder, arguments.pieces, rng, option_names)
    rows: list[dict[str, object]] = []
    for case in cases:
        rows += axes(case)
    axis_rows = pd.DataFrame(rows)
    show(arguments.page, {"floor": f"Seed {seed}.\n\n{table(axis_rows)}"})


if __name__ == "__main__":
    main()
