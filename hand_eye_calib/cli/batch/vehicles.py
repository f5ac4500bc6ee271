"""What the recordings of one vehicle say together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.cli.batch.results import Row, row_of
from hand_eye_calib.cli.batch.workers import Outcome
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.results.calibration import Calibration, SolveStatus
from hand_eye_calib.session.agreement import Agreement
from hand_eye_calib.session.compare import Comparison, agreement_of_results, compare

_FAILURES = (SolveStatus.NOT_CONVERGED, SolveStatus.CONTRADICTED)


@dataclass(frozen=True)
class Vehicle:
    """The recordings of one rig, in the order of time.

    Attributes
    ----------
    name : str
    frames : (str, str)
        Of parent and child.
    rows : tuple of dict
    agreement : Agreement
    sentence : str
        What the comparison of all found.
    newest : Comparison or None
        Of the newest recording with what the earlier ones say together.
    """

    name: str
    frames: tuple[str, str]
    rows: tuple[Row, ...]
    agreement: Agreement
    sentence: str
    newest: Comparison | None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values."""
        found, names = self.agreement, [row["name"] for row in self.rows]
        return {
            "vehicle": self.name,
            "frames": list(self.frames),
            "recordings": names,
            "kind": found.kind.value,
            "apart": [names[index] for index in found.apart],
            "sentence": self.sentence,
            "chi2": found.chi2,
            "degrees_of_freedom": found.dof,
            "p_value": found.p_value,
            "scatter": found.scatter,
            "T_parent_child": found.T_parent_child.tolist(),
            "covariance_in_parent": found.covariance.tolist(),
            "newest": self.newest.to_dict() if self.newest else None,
        }


def vehicles_of(outcomes: Sequence[Outcome]) -> list[Vehicle]:
    """The calibrated recordings of each vehicle, compared with each other.

    Recordings of other frames are another rig. What failed, what must not be used, and recordings
    whose vehicle is not known are left out.
    """
    groups: dict[tuple[str, tuple[str, str]], list[tuple[Row, Calibration]]] = {}
    for outcome in outcomes:
        if outcome["calibration"] and outcome["vehicle"]:
            row, calibration = row_of(outcome), Calibration.from_dict(outcome["calibration"])
            if calibration.status not in _FAILURES:
                frames = (calibration.parent_frame, calibration.child_frame)
                groups.setdefault((row["vehicle"], frames), []).append((row, calibration))
    return [_vehicle(name, frames, group) for (name, frames), group in sorted(groups.items())]


def n_without_vehicle(outcomes: Sequence[Outcome]) -> int:
    """Number of calibrated recordings whose vehicle is not known."""
    return sum(bool(one["calibration"] and not one["vehicle"]) for one in outcomes)


def _vehicle(name: str, frames: tuple[str, str], group: list[tuple[Row, Calibration]]) -> Vehicle:
    ordered = sorted(group, key=lambda one: (one[0]["start_ns"] or 0, one[0]["name"]))
    rows = tuple(row for row, _ in ordered)
    calibrations = [calibration for _, calibration in ordered]
    found = agreement_of_results(calibrations)
    said = found.sentence([row["name"] for row in rows])
    return Vehicle(name, frames, rows, found, said, _newest(calibrations, rows[-1]["name"]))


def _newest(calibrations: Sequence[Calibration], name: str) -> Comparison | None:
    """The newest recording against what the earlier ones say together; None if there are none."""
    *earlier, newest = calibrations
    if not earlier:
        return None
    found = agreement_of_results(earlier)
    to_child = np.kron(np.eye(2), found.T_parent_child[:3, :3].T)
    covariance = to_child @ found.covariance @ to_child.T
    common = Extrinsic(found.T_parent_child, "earlier recordings", covariance, is_calibration=True)
    return compare([newest], common, [name])


def document_of(
    batch: str, outcomes: Sequence[Outcome], vehicles: Sequence[Vehicle]
) -> dict[str, Any]:
    """Everything as plain values."""
    return {
        "batch": batch,
        "results": list(outcomes),
        "failures": [outcome["name"] for outcome in outcomes if outcome["error"]],
        "vehicles": [vehicle.to_dict() for vehicle in vehicles],
    }
