"""Names for the kinds of NumPy arrays, for annotations; docstrings give their shapes."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

# Arrays of a few hundred kilobytes come and go by the thousand. glibc takes such memory from the
# system and gives it back each time, page by page, until a block as large as this one was freed;
# it is never written to, and takes no memory itself.
np.empty(1 << 24, dtype=np.uint8)
