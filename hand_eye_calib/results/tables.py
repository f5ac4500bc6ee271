"""Tables: rows of plain values as a DataFrame; how a result was solved, in words."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hand_eye_calib.errors import MissingDependencyError
from hand_eye_calib.text import given_or_estimated

if TYPE_CHECKING:
    import pandas as pd

    from hand_eye_calib.results.result import Result

Row = Mapping[str, Any]


def data_frame(rows: Sequence[Row], index: str | None = None) -> "pd.DataFrame":
    """A DataFrame of rows with equal names, one of which may be the index.

    Raises
    ------
    MissingDependencyError
        Without pandas.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError(
            "tables need pandas, which is not installed: pip install 'hand_eye_calib[notebook]'"
        ) from error
    frame = pd.DataFrame(list(rows))
    return frame if index is None else frame.set_index(index)


def summary(result: "Result") -> dict[str, str]:
    """How a result was solved, as names and values."""
    rate, proof = result.clock_rate, {"yes": "", "no": "not "}
    offset, method = result.time_offset_s, [f"{result.method} ({result.backend})"]
    rows = {
        "Method": "; ".join(filter(None, [*method, result.method_reason])),
        "Reference": result.reference_reason or result.reference,
        "Poses": f"{result.n_poses:,}",
        "Motion pairs": f"{result.n_inliers:,} of {result.n_pairs:,} are inliers",
        "Objective": f"{result.objective:.6g}",
        "Time offset": given_or_estimated(offset, result.time_offset_sigma_s, "s"),
        "Scale": given_or_estimated(result.scale, result.scale_sigma, ""),
    }
    if result.proved_global in proof:
        rows["Objective"] += f", {proof[result.proved_global]}proved to be the global minimum"
    if rate and rate.is_used:
        rows["Time offset"] += f" at {rate.at_ns * 1e-9:.3f} s; the child's clock is {rate}"
    if result.noise:
        rows["Noise"] = "; ".join(result.noise.in_words)
    return rows
