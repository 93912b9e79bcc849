"""Transients and noise are distinguished in averages of periods."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.responses.spectral_lines import remainder

PARTS, LINES = 4, 120


def noise(seed, shape):
    random = np.random.default_rng(seed)
    return random.standard_normal(shape) + 1j * random.standard_normal(shape)


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_has_no_transient(seed):
    deviation = np.sqrt(2.0 / PARTS)
    assert np.median(remainder(noise(seed, (PARTS, 1, LINES)))) < 0.15 * deviation


@pytest.mark.parametrize("decays", [0.3, 2.0, 8.0])
def test_transient_remainder_bounds_the_mean(decays):
    # A mode between two lines, with this decay in a period. Its transient covers few or many lines.
    pole = (-decays + 2j * np.pi * 60.3) / (2j * np.pi)
    first = 40.0 / (np.arange(LINES) - pole)
    transient = first * np.exp(2j * np.pi * pole * np.arange(PARTS))[:, None, None]
    reported = remainder(transient + 0.05 * noise(1, (PARTS, 1, LINES)))[0]
    error = abs(transient.mean(axis=0)[0])
    large = error > 0.2
    assert np.mean(reported[large] > 0.8 * error[large]) > 0.9
