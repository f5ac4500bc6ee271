"""A status on ``/diagnostics``: level, message and values."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

HARDWARE_ID = "hand_eye_calib"
OK: bytes = DiagnosticStatus.OK
WARN: bytes = DiagnosticStatus.WARN
ERROR: bytes = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Report:
    """What one part of the node says about itself; WARN only if a person should act."""

    level: bytes
    text: str
    values: Mapping[str, object] = field(default_factory=dict)


def to_status(node_name: str, part: str, report: Report) -> DiagnosticStatus:
    """The message of a report.

    Parameters
    ----------
    node_name : str
        Fully qualified, such as ``/robot1/calibrator``: two nodes must be told apart.
    part : str
        Such as ``extrinsic``.
    report : Report
    """
    pairs = [KeyValue(key=key, value=str(value)) for key, value in report.values.items()]
    return DiagnosticStatus(
        level=report.level,
        name=f"{node_name}: {part}",
        message=report.text,
        hardware_id=HARDWARE_ID,
        values=pairs,
    )
