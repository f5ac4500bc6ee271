"""Parts of long arrays."""

# Rows that are computed at a time: what is computed of them stays in the cache, and needs no large
# array of its own.
_CHUNK = 4096


def chunks(n_rows: int) -> list[slice]:
    """Parts of the rows of an array to compute one after the other."""
    ends = [*range(_CHUNK, n_rows, _CHUNK), n_rows]
    return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]
