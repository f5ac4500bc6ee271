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
    of_newest : str
        The same in a sentence; empty without one.
    """

    name: str
    frames: tuple[str, str]
    rows: tuple[Row, ...]
    agreement: Agreement
    sentence: str
    newest: Comparison | None
    of_newest: str

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
            calibration = Calibration.from_dict(outcome["calibration"])
            if calibration.status not in _FAILURES:
                frames = (calibration.parent_frame, calibration.child_frame)
                group = groups.setdefault((outcome["vehicle"], frames), [])
                group.append((row_of(outcome), calibration))
    return [_vehicle(name, frames, group) for (name, frames), group in sorted(groups.items())]


def _vehicle(name: str, frames: tuple[str, str], group: list[tuple[Row, Calibration]]) -> Vehicle:
    group.sort(key=lambda one: (one[0]["start_ns"] or 0, one[0]["name"]))
    rows = tuple(row for row, _ in group)
    *earlier, last = (calibration for _, calibration in group)
    found = agreement_of_results([*earlier, last])
    newest, of_newest = None, ""
    if earlier:
        before = agreement_of_results(earlier)
        to_child = np.kron(np.eye(2), before.T_parent_child[:3, :3].T)
        covariance = to_child @ before.covariance @ to_child.T
        common = Extrinsic(
            before.T_parent_child, "earlier recordings", covariance, is_calibration=True
        )
        newest = compare([last], common, [rows[-1]["name"]])
        of_newest = f"{rows[-1]['name']} against the earlier ones: {newest.sentence}."
    said = found.sentence([row["name"] for row in rows])
    return Vehicle(name, frames, rows, found, said, newest, of_newest)
