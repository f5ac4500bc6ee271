"""Table of the stops in a result, with residuals, views, and advice on the next stops."""

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
    """A stop, as a row of the table.

    Attributes
    ----------
    number : int
        Number of the stop in the order of the input, from 1.
    residual_m, residual_deg : float
        Distance and angle between the measured pose and the pose that the result predicts.
    is_used : bool
        Whether the fit uses the stop; False for an outlier.
    position_m : tuple of 3 floats
        Position of the child sensor in its world, such as the camera in the frame of the target.
    direction : tuple of 3 floats
        Optical axis: unit vector of the child sensor's z axis, in its world.
    """

    number: int
    residual_m: float
    residual_deg: float
    is_used: bool
    position_m: tuple[float, ...]
    direction: tuple[float, ...]


@dataclass(frozen=True)
class StopTable:
    """All stops of a result, and advice.

    Attributes
    ----------
    rows : tuple of Stop
        All stops in the order of the input.
    start : int
        Number of the stop at which the advised turns start; 0 without advice.
    next : tuple of NextStop
        Advised stops, the most useful one first; empty if the stops contradict each other.
    advice : str
        Advised stops as a sentence.
    """

    rows: tuple[Stop, ...]
    start: int = 0
    next: tuple[NextStop, ...] = ()
    advice: str = ""


def stop_table(
    errors: FloatArray, weights: FloatArray, Ts_world_child: FloatArray
) -> tuple[Stop, ...]:
    """Return the rows of a table.

    Parameters
    ----------
    errors : (N, 6) array
        Residuals of the stops: translation (m), rotation (rad).
    weights : (N,) array
        Weights of the stops; 0 for outliers.
    Ts_world_child : (N, 4, 4) array
        Measured poses of the child in its world.
    """
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
    """Part ``stops`` of a result. Documents of other results lack this field."""

    def __init__(self) -> None:
        super().__init__("stops", lambda: StopTable)

    def write(self, value: StopTable | None) -> Document:
        """Return the field ``stops`` of a document; empty if the result has no such part."""
        return {} if value is None else {"stops": value}

    def advice(self, value: StopTable, result: Any) -> str:
        """Return the advice on the next stops as a sentence; empty if there is none."""
        return value.advice

    def facts(self, value: StopTable, result: Any) -> list[str]:
        """Return a line with the residual of each stop, and the number of outliers."""
        rows = "; ".join(map(_row_in_words, value.rows))
        n_out = sum(not row.is_used for row in value.rows)
        return [
            f"residuals of the stops; {n_out} of {len(value.rows)} left out (weight 0): {rows}"
        ]


def _row_in_words(row: Stop) -> str:
    """Return number and residual of a stop in words."""
    left_out = "" if row.is_used else " (left out)"
    residual_rad = float(np.radians(row.residual_deg))
    return f"{row.number}{left_out}: {length(row.residual_m)}, {angle(residual_rad)}"
