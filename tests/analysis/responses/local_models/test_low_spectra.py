"""Spectra of the lowest bins, computed from decimated samples, compared with the complete Fourier transform."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft

from analysis.core.responses.local_models import low_spectra as module
from analysis.core.responses.local_models.low_spectra import low_spectra
from rig.core.base.errors import RunError
from tests.peak_memory import peak_memory


def recording_of(samples: NDArray[np.float64]) -> Any:
    """Return a substitute for a recording of channels a, b, ..."""
    read = lambda name, start, stop: samples[ord(name) - ord("a"), start:stop]  # noqa: E731
    return SimpleNamespace(path="a.mcap", read=read)


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


def test_many_channels_need_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    count, bins = 65_536, 1000
    recording = recording_of(np.random.default_rng(2).standard_normal((16, count)))
    whole, _ = low_spectra(recording, "abcdefghijklmnop", 0, count, count, bins)
    # The partial sums of the low-pass filter are larger than the decimated samples of all channels.
    monkeypatch.setattr(module, "_MAX_ELEMENTS", 1 << 18)
    peaks = []
    for names in ("ab", "abcdefghijklmnop"):
        peak, (spectra, _) = peak_memory(low_spectra, recording, names, 0, count, count, bins)
        peaks.append(peak - spectra.nbytes)
    np.testing.assert_array_equal(spectra, whole)
    assert peaks[1] < 1.2 * peaks[0]


def test_too_many_channels_are_refused() -> None:
    with pytest.raises(RunError, match=r"a\.mcap: the spectra of 26 channels .*`response`"):
        low_spectra(recording_of(np.empty((0, 0))), "abcdefghijklmnopqrstuvwxyz", 0, 10**8, 10**8, 10**6)
