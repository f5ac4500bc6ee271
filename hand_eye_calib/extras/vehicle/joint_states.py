"""Read the wheels of a vehicle from joint states in bags."""

import re
from typing import Any

import numpy as np

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle.wheel_files import wheel_trajectory
from hand_eye_calib.formats.bags.messages import Run, ns_of
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.sources import Reading


class JointStateReading(Reading):
    """Reader of the left and the right wheels in messages ``sensor_msgs/JointState``.

    Parameters
    ----------
    stream, topic : str
    names : str
        Names of the joints, separated by commas: the left wheels, then as many right wheels. Empty
        for the joints with the words "wheel" and "left" or "right" in their names.
    """

    def __init__(self, stream: str, topic: str, names: str) -> None:
        super().__init__(stream, topic)
        self._names = [name for name in names.split(",") if name]
        if len(self._names) % 2:
            raise InputError(
                f"{topic}: name as many right wheels as left wheels; got {listing(self._names)}"
            )
        self._rows: list[tuple[int, int, list[float]]] = []
        self._are_positions = False

    def take(self, run: Run) -> None:
        """Read the next messages; raise InputError if their wheels are unclear."""
        for message, bag_ns in zip(run.decoded(), run.bag_ns.tolist(), strict=True):
            self._names = self._names or self._wheels_among([*message.name])
            if not self._names or not set(self._names) <= set(message.name):
                # Other joints may be published on the same topic.
                continue
            self._are_positions = not len(message.velocity)
            values = message.position if self._are_positions else message.velocity
            by_name = dict(zip(message.name, values, strict=False))
            row = [float(by_name.get(name, np.nan)) for name in self._names]
            self._rows.append((ns_of(message.header.stamp) or 0, bag_ns, row))

    def _wheels_among(self, joints: list[str]) -> list[str]:
        """Return the names of the left and the right wheels; an empty list without wheels."""
        wheels = [name for name in joints if "wheel" in name.lower()]
        left = [name for name in wheels if re.search("left|_l(_|$)|^l_", name.lower())]
        right = [name for name in wheels if re.search("right|_r(_|$)|^r_", name.lower())]
        if not wheels:
            return []
        if not left or len(left) != len(right):
            raise InputError(
                f"{self.name}: the left and the right wheels are unclear among the joints "
                f"{listing(joints)}; name them: {self.name}?LEFT,RIGHT"
            )
        return [*left, *right]

    def table(self) -> PoseTable:
        """Return the path of the unit vehicle; raise InputError if no message has wheels."""
        if not self._rows:
            raise InputError(
                f"{self.name}: no message has wheels; name the joints: {self.name}?LEFT,RIGHT"
            )
        half = len(self._names) // 2
        left, right = self._names[:half], self._names[half:]
        self.notes.append(f"{self.name}: left {listing(left)}, right {listing(right)}")
        stamps, bag_ns, rows = zip(*self._rows, strict=True)
        values: Any = np.array(rows)
        stamps_ns = np.array(stamps, dtype=np.int64)
        bag_times_ns = np.array(bag_ns, dtype=np.int64)
        if self.stamps == "receive":
            stamps_ns = bag_times_ns
        is_used = np.isfinite(values).all(axis=1)
        # Messages that repeat a stamp, or are earlier than a message before them, are skipped.
        earlier_ns = np.maximum.accumulate(np.insert(stamps_ns[:-1], 0, stamps_ns[0] - 1))
        is_used &= stamps_ns > earlier_ns
        if not is_used.all():
            self.notes.append(
                f"{self.name}: {(~is_used).sum()} messages without values, or with stamps that do "
                "not increase, were left out"
            )
        values = values[is_used]
        stamps_ns = stamps_ns[is_used]
        if self._are_positions and len(values) > 1:
            values = np.gradient(np.unwrap(values, axis=0), stamps_ns * 1e-9, axis=0)
        rates = np.column_stack([values[:, :half].mean(axis=1), values[:, half:].mean(axis=1)])
        wheels = wheel_trajectory(stamps_ns, rates, "wheels")
        table = PoseTable.of(stamps_ns, se3.to_rows(wheels.poses), "", wheels.sensor_frame)
        return self._stamped(table.recorded(self.stream, bag_times_ns[is_used]))
