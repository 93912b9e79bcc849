"""Spectra of the lowest bins, computed from decimated samples, compared with the complete Fourier transform."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft

from analysis.core.responses.local_models.low_spectra import low_spectra


def recording_of(samples: NDArray[np.float64]) -> Any:
    """Return a substitute for a recording of channels a and b."""
    return SimpleNamespace(read=lambda name, start, stop: samples["ab".index(name), start:stop])


@pytest.mark.parametrize(
    ("count", "start", "zeros", "bins"),
    [(300_000, 100, 0, 700), (300_000, 7, 1234, 700), (100_001, 0, 99, 3000), (5000, 3, 500, 2501)],
    ids=["decimated", "zero-padded", "odd length", "all bins"],
)
def test_low_bins_equal_complete_transform(count: int, start: int, zeros: int, bins: int) -> None:
    samples = np.random.default_rng(1).standard_normal((2, start + count + 50)) + 3.0
    size = fft.next_fast_len(count + zeros, real=True)
    block = samples[:, start : start + count]
    block = block - block.mean(axis=1, keepdims=True)
    expected = fft.rfft(np.pad(block, ((0, 0), (size - count, 0))), axis=1)[:, :bins]

    spectra, squares = low_spectra(recording_of(samples), "ab", start, start + count, size, bins)

    np.testing.assert_allclose(spectra, expected, atol=1e-11 * np.sqrt(np.mean(abs(expected) ** 2)))
    np.testing.assert_allclose(squares, block.var(axis=1), rtol=1e-12)
