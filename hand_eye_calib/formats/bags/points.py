"""Points of PointCloud2 messages."""

from typing import Any

import numpy as np

from hand_eye_calib.core.base.errors import InputError

# numpy's name of each datatype of a PointField.
_DATATYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")


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
        formats = [byte_order + _DATATYPES[field.datatype] for field in fields.values()]
        offsets = [field.offset for field in fields.values()]
        dtype = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
        )
        data = np.asarray(message.data, dtype=np.uint8)[: message.height * row_step]
        rows = data.reshape(message.height, row_step)[:, :width]
        return np.ascontiguousarray(rows).reshape(-1).view(dtype)
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(
            f"a scan of points is damaged ({error}); record it again"
        ) from error
