"""Decompression that stops at a limit, whatever the compressed data claims.

zstd and lz4 come with the library rosbags; they are imported only for compressed bags.
"""

import bz2
import io
import sys
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, Protocol

from hand_eye_calib.io.limits import LARGEST_RATIO, SMALLEST_UNPACKED

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# zstd allocates a window before the first byte. Recorders use windows of up to 8 MiB.
_LARGEST_WINDOW_LOG = 25
_PIECE = 1 << 20


class Budget:
    """Bytes that the content of one file may still unpack to.

    Parameters
    ----------
    file_size : int
        Bytes of the file.
    """

    def __init__(self, file_size: int) -> None:
        self._left = SMALLEST_UNPACKED + LARGEST_RATIO * file_size
        self._total = self._left

    def spend(self, size: int) -> None:
        """Take bytes from the budget.

        Raises
        ------
        ValueError
            If there are fewer left.
        """
        self._left -= size
        if self._left < 0:
            raise ValueError(
                f"its content unpacks to more than {self._total} bytes, which is not believable"
            )


class _Decompressor(Protocol):
    """The common part of the incremental decompressors of bz2, lz4 and zstd."""

    @property
    def eof(self) -> bool: ...

    @property
    def needs_input(self) -> bool: ...

    @property
    def unused_data(self) -> bytes | None: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def unpack(data: bytes | memoryview, compression: str, limit: int, budget: Budget) -> bytes:
    """Decompress data of one or more frames.

    Parameters
    ----------
    data : bytes-like
    compression : str
        "zstd", "lz4" or "bz2".
    limit : int
        Bytes that it may unpack to.
    budget : Budget
        What all of the file may unpack to; spent by what this does.

    Returns
    -------
    bytes

    Raises
    ------
    ValueError
        If the data is damaged, is not complete, or unpacks to more than the limit.
    """
    unpacked = io.BytesIO()
    with _clear_errors(compression):
        for piece in _pieces(bytes(data), compression):
            budget.spend(len(piece))
            if unpacked.tell() + len(piece) > limit:
                raise ValueError(f"{compression} data unpacks to more than {limit} bytes")
            unpacked.write(piece)
    return unpacked.getvalue()


def _pieces(data: bytes, compression: str) -> Iterator[bytes]:
    """Decompressed pieces of limited size, of all frames in the data."""
    while data:
        decompressor = _decompressor(compression)
        pending = data
        while not decompressor.eof:
            piece = decompressor.decompress(pending, _PIECE)
            if not piece and decompressor.needs_input and not decompressor.eof:
                raise ValueError(f"its {compression} data is not complete")
            yield piece
            pending = b""
        data = decompressor.unused_data or b""


class _clear_errors:
    """Turn errors of the compression libraries, of kinds of their own, into ValueError."""

    def __init__(self, compression: str) -> None:
        self._compression = compression

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if isinstance(error, Exception) and not isinstance(
            error, (ValueError, ModuleNotFoundError)
        ):
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"its {self._compression} data is damaged: {reason}") from error


def _decompressor(compression: str) -> _Decompressor:
    if compression not in _DECOMPRESSORS:
        raise ValueError(f"unknown compression {compression[:20]!r}")
    return _DECOMPRESSORS[compression]()


def open_zstd(file: BinaryIO) -> BinaryIO:
    """A compressed file as one to read the content from."""
    module = _zstd()
    unpacked: BinaryIO = module.open(file, "rb", options=_zstd_options(module))
    return unpacked


def _zstd() -> Any:
    """The zstd module: Python's own from 3.14 on, its backport before."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        import backports.zstd as module
    return module


def _zstd_options(module: Any) -> dict[Any, int]:
    return {module.DecompressionParameter.window_log_max: _LARGEST_WINDOW_LOG}


def _zstd_decompressor() -> _Decompressor:
    module = _zstd()
    decompressor: _Decompressor = module.ZstdDecompressor(options=_zstd_options(module))
    return decompressor


def _lz4_decompressor() -> _Decompressor:
    import lz4.frame

    decompressor: _Decompressor = lz4.frame.LZ4FrameDecompressor()
    return decompressor


_DECOMPRESSORS: dict[str, Callable[[], _Decompressor]] = {
    "zstd": _zstd_decompressor,
    "lz4": _lz4_decompressor,
    "bz2": bz2.BZ2Decompressor,
}
