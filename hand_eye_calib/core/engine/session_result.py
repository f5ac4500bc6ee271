"""Result of a node's session, for the process that writes the pages of the session."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True)
class SessionResult:
    """Result of the node with its data.

    Attributes
    ----------
    calibration : Calibration
    snapshot : Snapshot
        Poses and options of the result.
    inputs : dict
        Sources of the poses as plain data: options, topics and statistics.
    with_report : bool
        Whether to write a report.
    others : mapping of str to Snapshot
        Snapshots of further child sensors with the same parent: name of the input to snapshot.
    """

    calibration: Calibration
    snapshot: Snapshot
    inputs: Document
    with_report: bool = True
    others: Mapping[str, Snapshot] = field(default_factory=dict)
