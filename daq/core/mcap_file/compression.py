"""Compression of the chunks of an MCAP file; the method depends on the content of the chunk.

zstd compresses messages with repeated fields to a fifth. No compression shrinks float64 samples by more than a tenth;
lz4 packs them four times as fast as zstd and unpacks them eight times as fast.
"""

from collections.abc import Callable
from typing import NamedTuple

# This level compresses messages as much as zstd's default level 3, in 60 % of the time.
_LEVEL = 1
# Sizes of the hash tables, log2. A table that fits into the first-level cache of a processor is faster than the default
# table of the level. Noisy counts and float32 samples rarely contain repeated sequences of bytes. A short search for
# long sequences takes half the time and compresses 24-bit counts to 61 % instead of 57 %. Unpacking takes 75 % of the
# time.
_HASH_LOG = 12
_SAMPLES_HASH_LOG = 8
_SAMPLES_MIN_MATCH = 7


class Compressor(NamedTuple):
    """A compression, and its name in the file. Creating a compressor takes as long as compressing a small chunk."""

    name: bytes
    compress: Callable[[bytes], bytes]


def zstd() -> Compressor:
    """Return the compressor of messages in general."""
    return _zstd(hash_log=_HASH_LOG)


def zstd_for_samples() -> Compressor:
    """Return the compressor of counts and float32 samples."""
    return _zstd(hash_log=_SAMPLES_HASH_LOG, min_match=_SAMPLES_MIN_MATCH)


def _zstd(**parameters: int) -> Compressor:
    from zstandard import ZstdCompressionParameters, ZstdCompressor

    parameters_of_level = ZstdCompressionParameters.from_level(_LEVEL, **parameters)
    return Compressor(b"zstd", ZstdCompressor(compression_params=parameters_of_level).compress)


def lz4() -> Compressor:
    """Return the compressor of float64 samples."""
    import lz4.frame  # type: ignore[import-untyped]

    return Compressor(b"lz4", lz4.frame.compress)
