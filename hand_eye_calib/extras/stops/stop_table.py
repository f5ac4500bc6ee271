"""Residuals and views of single stops, and advice on the next stops, as a part of results."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.parts import Part
from hand_eye_calib.extras.stops.next_stops import NextStop


@dataclass(frozen=True)
class Stop:
    """One stop.

    Attributes
    ----------
    number : int
        From 1, in the order of the input.
    residual_m, residual_deg : float
        Distance and angle between the measured pose and that of the result.
    is_used : bool
        False if the stop was left out as an outlier.
    position_m : tuple of 3 floats
        Child sensor in its world: the camera in the frame of the target.
    direction : tuple of 3 floats
        Unit vector of the child sensor's z axis, in its world: the optical axis.
    """

    number: int
    residual_m: float
    residual_deg: float
    is_used: bool
    position_m: tuple[float, ...]
    direction: tuple[float, ...]


@dataclass(frozen=True)
class StopTable:
    """All stops of a result.

    Attributes
    ----------
    rows : tuple of Stop
    start : int
        Number of the stop that the next stops start from.
    next : tuple of NextStop
        Stops to add, the most useful first; empty if the stops contradict each other.
    advice : str
        The next stops in a sentence.
    """

    rows: tuple[Stop, ...]
    start: int = 0
    next: tuple[NextStop, ...] = ()
    advice: str = ""


def stop_table(
    errors: FloatArray, weights: FloatArray, Ts_world_child: FloatArray
) -> tuple[Stop, ...]:
    """Return the stops of errors (N, 6), weights (N,) and poses (N, 4, 4) in the child's world."""
    distances_m = np.linalg.norm(errors[:, :3], axis=1)
    angles_deg = np.degrees(np.linalg.norm(errors[:, 3:], axis=1))
    positions_m = map(tuple, se3.translation_of(Ts_world_child).tolist())
    directions = map(tuple, se3.rotation_of(Ts_world_child)[:, :, 2].tolist())
    columns = (
        range(1, len(errors) + 1),
        distances_m.tolist(),
        angles_deg.tolist(),
        (weights > 0.0).tolist(),
        positions_m,
        directions,
    )
    return tuple(map(Stop, *columns))


class StopsPart(Part):
    """The part ``stops``; documents of other results have no such field."""

    def __init__(self) -> None:
        super().__init__("stops", lambda: StopTable)

    def write(self, value: StopTable | None) -> Document:
        """Return the field of a document."""
        return {} if value is None else {"stops": value}

    def advice(self, value: StopTable, result: Any) -> str:
        """Return which stops to add."""
        return value.advice

    def facts(self, value: StopTable, result: Any) -> list[str]:
        """Return the residual of each stop."""
        return [f"residuals of the stops: {'; '.join(map(_row_in_words, value.rows))}"]


def _row_in_words(row: Stop) -> str:
    """Return number and residual of a stop as text."""
    left_out = "" if row.is_used else " (left out)"
    residual_rad = float(np.radians(row.residual_deg))
    return f"{row.number}{left_out}: {length(row.residual_m)}, {angle(residual_rad)}"
