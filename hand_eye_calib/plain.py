"""Plain data: what JSON and YAML know, and nothing of NumPy."""

import json
import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """A value with all that it holds as mappings, lists, texts, bools and numbers.

    Numbers and arrays of NumPy become those of Python, an enum its value. Infinity and NaN, which
    JSON does not have, become None.
    """
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def json_text(document: Any) -> str:
    """One JSON document, as people can read it."""
    return json.dumps(plain(document), indent=2, allow_nan=False)
