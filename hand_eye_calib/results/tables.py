"""Tables: rows of plain values as a DataFrame."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hand_eye_calib.errors import MissingDependencyError

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]


def data_frame(rows: Sequence[Row], index: str | None = None) -> "pd.DataFrame":
    """A DataFrame of rows with equal names, one of which may be the index.

    Raises
    ------
    MissingDependencyError
        Without pandas.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError(
            "tables need pandas, which is not installed: pip install 'hand_eye_calib[notebook]'"
        ) from error
    frame = pd.DataFrame(list(rows))
    return frame if index is None else frame.set_index(index)
