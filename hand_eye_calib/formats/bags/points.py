"""Points of PointCloud2 messages."""

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import frame_name

if TYPE_CHECKING:
    from hand_eye_calib.formats.bags.reader import PoseBag

# NumPy names of the datatypes of a PointField.
_DATATYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")

# Names of the time of a point in the messages of various drivers.
_TIME_FIELDS = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "offset_time",
    "timeOffset",
    "ts",
)
# Longest duration of a scan (ns). Messages do not state the unit of the times of points. The unit
# is assumed to be the largest one for which no scan is longer.
_LONGEST_NS = 1e9


def rows_of_points(message: Any) -> Any:
    """Return the points of a PointCloud2 message as a structured array (N,).

    Raises
    ------
    InputError
        If the message has no x, y and z, or is damaged.
    """
    # Some drivers repeat the names of unused fields.
    fields = {field.name: field for field in message.fields}
    names = [*fields]
    if not {*"xyz"} <= {*names}:
        raise InputError(f"points have no x, y, z, but {', '.join(names)}")
    size = message.point_step
    width = message.width * size
    # Rows of an organised cloud may end in unused bytes.
    row_step = max(message.row_step, width) if message.height > 1 else width
    byte_order = ">" if message.is_bigendian else "<"
    try:
        formats = [
            byte_order + _DATATYPES[field.datatype] for field in fields.values()
        ]
        offsets = [field.offset for field in fields.values()]
        dtype = np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "itemsize": size,
            }
        )
        data = np.asarray(message.data, dtype=np.uint8)
        data = data[: message.height * row_step]
        rows = data.reshape(message.height, row_step)[:, :width]
        return np.ascontiguousarray(rows).reshape(-1).view(dtype)
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(
            f"a scan of points is damaged ({error}); record it again"
        ) from error


def times_of_points(rows: Any, header_ns: int) -> tuple[FloatArray, int]:
    """Return the times (N,) of points (s) since the middle of their scan, and its stamp (ns).

    ``rows`` are points from :func:`rows_of_points`, and ``header_ns`` is the stamp of the header.
    Without times of points, all points are assumed to be measured at this stamp.
    """
    times = np.zeros(len(rows))
    time_field = next(
        (name for name in _TIME_FIELDS if name in rows.dtype.names), ""
    )
    if time_field:
        times = rows[time_field].astype(float)
    first = times.min() if len(times) else 0.0
    last = times.max() if len(times) else 0.0
    duration = last - first
    units_ns = [
        ns for ns in STAMP_UNITS.values() if 0 < duration * ns <= _LONGEST_NS
    ]
    unit_ns = max(units_ns, default=0)
    middle = (first + last) / 2
    stamp_ns = round(float(middle) * unit_ns)
    if stamp_ns <= _LONGEST_NS:
        # The times of the points are relative to the stamp in the header.
        stamp_ns += header_ns
    return (times - middle) * unit_ns * 1e-9, stamp_ns


def topics_and_frames(
    bag: "PoseBag", message_type: str
) -> Iterator[tuple[str, str]]:
    """Yield topics of a type and the frames of their first messages.

    The topic with most messages is first. Topics without a readable message are skipped.
    """
    topics = [
        topic for topic in bag.topics.values() if topic.type == message_type
    ]
    for topic in sorted(topics, key=lambda topic: -topic.count):
        run = next(bag.runs([topic.name]), None)
        if run is None:
            continue
        first = run._replace(messages=run.messages[:1])
        with suppress(InputError):  # a damaged message
            message = next(first.decoded())
            yield topic.name, frame_name(message.header.frame_id)
