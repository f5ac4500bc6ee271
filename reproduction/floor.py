"""``python -m reproduction.floor --data-folder DIR``: is the common-mode floor as wide as it should
be on rigs that it was not chosen on?

Its sizes are chosen by likelihood on all families of real recordings but one, each family for as
much as any other, and judged on that one. Pieces of recordings are drawn anew at every run.
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
from reproduction.coverage.scores import answer
from reproduction.gate.cases import Case, real_cases
from reproduction.writing import markdown_table, seed_of, show, study_parser

_REACH = 1.645
# Errors beyond so many standard deviations say no more about a size.
_FARTHEST = 3.0

# Sizes to choose from: translation (m), rotation (rad), and translation per speed (s).
_SIZES = (
    (0.001, 0.003, 0.005, 0.01),
    np.radians((0.05, 0.1, 0.15, 0.2)),
    (0.0, 0.0025, 0.005, 0.0075, 0.01),
)


def axes(case: Case) -> Iterator[dict[str, object]]:
    """Error and variances of the axes that are known and that the motion shows; ``rest`` is what is
    in the floor besides its sizes.
    """
    parent = case.streams[0]
    result = answer(*case.streams, case.options)
    if result is None:
        return
    speed_m_s = usual_speed(parent.stamps_ns, parent.poses[:, :3, 3])
    stated = result.sigmas_measured**2
    whole = result.sigmas**2
    error = deviation(result.T_parent_child, case.T_parent_child)
    for k in np.flatnonzero(np.isfinite(stated) & np.isfinite(case.sigmas)):
        yield {
            "family": case.family,
            "turns": k > 2,
            "speed": speed_m_s,
            "error": error[k],
            "truth": case.sigmas[k] ** 2,
            "stated": stated[k],
            "whole": whole[k],
            "rest": max(
                whole[k] - stated[k] - common_mode_floor(speed_m_s)[k, k], 0.0
            ),
        }


def _variances(
    axis_rows: pd.DataFrame, sizes: tuple[float, float, float]
) -> FloatArray:
    """Stated variances with a floor of these sizes."""
    translation, rotation, travel_s = sizes
    of_speed = translation**2 + (travel_s * axis_rows["speed"]) ** 2
    fixed = np.where(axis_rows["turns"], rotation**2, of_speed)
    return np.asarray(axis_rows["stated"] + axis_rows["rest"] + fixed)


def chosen(axis_rows: pd.DataFrame) -> tuple[float, float, float]:
    """The likeliest sizes of the floor."""

    def loss(sizes: tuple[float, float, float]) -> float:
        variances = _variances(axis_rows, sizes) + axis_rows["truth"]
        far = np.minimum(axis_rows["error"] ** 2 / variances, _FARTHEST**2)
        return float(
            (np.log(variances) + far).groupby(axis_rows["family"]).mean().mean()
        )

    return min(product(*_SIZES), key=loss)


def _row(
    name: str, axis_rows: pd.DataFrame, sizes: str = ""
) -> dict[str, object]:
    far = np.abs(axis_rows["error"])
    row: dict[str, object] = {
        "Family": name,
        "Axes": len(axis_rows),
        "Chosen without it": sizes,
    }
    for title, of in (
        ("Covers then", "then"),
        ("As it is", "whole"),
        ("No floor", "stated"),
    ):
        inside = [
            far < _REACH * np.sqrt(axis_rows[of] + more)
            for more in (axis_rows["truth"], 0.0)
        ]
        row[title] = ", ".join(
            f"{100 * np.mean(shares):.0f} %" for shares in inside
        )
    floor = np.sqrt(axis_rows["whole"] - axis_rows["stated"])[
        ~axis_rows["turns"]
    ]
    largest = (far / np.sqrt(axis_rows["whole"] + axis_rows["truth"])).max()
    return row | {
        "Mean floor (mm)": f"{1e3 * floor.mean():.1f}",
        "Largest z": f"{largest:.1f}",
    }


def table(axis_rows: pd.DataFrame) -> str:
    """A row for every family, its floor chosen on the others; and one for all."""
    rows = []
    for family in axis_rows["family"].unique():
        is_left_out = axis_rows["family"] == family
        metres, radians, travel_s = sizes = chosen(axis_rows[~is_left_out])
        axis_rows.loc[is_left_out, "then"] = _variances(
            axis_rows[is_left_out], sizes
        )
        words = f"{1e3 * metres:g} mm, {np.degrees(radians):.2f} deg, {1e3 * travel_s:g} ms"
        rows.append(_row(family, axis_rows[is_left_out], words))
    return markdown_table([*rows, _row("all", axis_rows)])


def main() -> None:
    """Draw, solve and print."""
    parser = study_parser("reproduction.floor", __doc__)
    parser.add_argument(
        "--pieces", type=int, default=6, help="of each recording. Default: 6"
    )
    arguments = parser.parse_args()
    folder = arguments.data_folder or parser.error(
        "name the recordings with --data-folder"
    )
    seed = seed_of(None)
    asked = ("time_offset", "scale", "prior")
    cases = real_cases(
        folder, arguments.pieces, np.random.default_rng(seed), asked
    )
    axis_rows = pd.DataFrame([row for case in cases for row in axes(case)])
    show(arguments.page, {"floor": f"Seed {seed}.\n\n{table(axis_rows)}"})


if __name__ == "__main__":
    main()
