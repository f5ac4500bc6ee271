"""A result of a session of the node, as it goes to the process that writes its pages."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True)
class SessionResult:
    """A result of the node, the poses that gave it, and where these came from; whether a report is
    wanted, and the poses of further child sensors, each with those of the parent.
    """

    calibration: Calibration
    snapshot: Snapshot
    inputs: Document
    with_report: bool = True
    others: Mapping[str, Snapshot] = field(default_factory=dict)
