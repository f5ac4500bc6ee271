"""Read the wheels of a vehicle from joint states in bags."""

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle.joints import STEERED, WheelJoints
from hand_eye_calib.extras.vehicle.wheel_files import unit_path
from hand_eye_calib.formats.bags.messages import Run, ns_of
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.sources import Reading


class JointStateReading(Reading):
    """Reader of the wheels in messages ``sensor_msgs/JointState``.

    Parameters
    ----------
    stream, topic : str
    names : str
        Names of the joints, see :class:`~.joints.WheelJoints`.
    measures : str
        Kind of wheel data; "auto" for left and right wheels.
    """

    def __init__(
        self, stream: str, topic: str, names: str, measures: str = "auto"
    ) -> None:
        super().__init__(stream, topic)
        self._measures = "wheels" if measures == "auto" else measures
        self._joints = WheelJoints(topic, self._measures, names)
        # Stamp and bag time (ns) of each message, and its wheel data.
        self._rows: list[tuple[int, int, tuple[float, float]]] = []

    def take(self, run: Run) -> None:
        """Read the next messages. Raise InputError if the joints of the wheels are unclear."""
        for message, bag_ns in zip(
            run.decoded(), run.bag_ns.tolist(), strict=True
        ):
            row = self._joints.row(
                [*message.name], message.position, message.velocity
            )
            if row is not None:
                self._rows.append(
                    (ns_of(message.header.stamp) or 0, bag_ns, row)
                )

    def table(self) -> PoseTable:
        """Return the path of the unit vehicle. Raise InputError if no message has wheels."""
        joints = self._joints.joints
        if joints is None or not self._rows:
            raise InputError(
                f"{self.name}: no message has wheels; {self._joints.expected}"
            )
        words = (
            ("wheels", "steering")
            if self._measures in STEERED
            else ("left", "right")
        )
        self.notes.append(
            f"{self.name}: {words[0]} {listing(joints.first)}, {words[1]} {listing(joints.second)}"
        )
        stamps, bag_ns, rows = zip(*self._rows, strict=True)
        values = np.array(rows)
        bag_times_ns = np.array(bag_ns, dtype=np.int64)
        is_received = self.stamps == "receive"
        stamps_ns = (
            bag_times_ns if is_received else np.array(stamps, dtype=np.int64)
        )
        is_used = self._usable(values, stamps_ns)
        stamps_ns = stamps_ns[is_used]
        means = self._joints.means(stamps_ns, values[is_used])
        wheels = unit_path(stamps_ns, means, self._measures)
        table = PoseTable.of(
            stamps_ns, se3.to_rows(wheels.poses), "", wheels.sensor_frame
        )
        return self._stamped(table.recorded(self.stream, bag_times_ns[is_used]))

    def _usable(self, values: FloatArray, stamps_ns: IntArray) -> BoolArray:
        """Return a mask (N,) of messages whose values are complete and whose stamps increase."""
        earlier_ns = np.maximum.accumulate(
            np.insert(stamps_ns[:-1], 0, stamps_ns[0] - 1)
        )
        is_used = np.isfinite(values).all(axis=1) & (stamps_ns > earlier_ns)
        if not is_used.all():
            self.notes.append(
                f"{self.name}: {(~is_used).sum()} messages without values, or with stamps that do "
                "not increase, were left out"
            )
        return np.asarray(is_used, dtype=bool)
