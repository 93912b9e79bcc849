"""Peaks of sampled curves against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import find_peaks

from rig.numerics.peaks import distant_maxima, prominent_maxima


@pytest.mark.parametrize("seed", range(5))
def test_peaks_equal_those_of_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    # Rounded values have plateaus and peaks of equal height.
    for values in (random.standard_normal(300), np.cumsum(random.integers(-1, 2, 300)).astype(float)):
        np.testing.assert_array_equal(distant_maxima(values, 7), find_peaks(values, distance=7)[0])
        np.testing.assert_array_equal(
            prominent_maxima(values, 2.0, 0.0), find_peaks(values, prominence=2.0, height=0.0)[0]
        )
