"""The damping of an exponential window is removed from modes."""

import numpy as np
import pytest

import analysis
from analysis.core.modal.modes import Modes
from rig.core.base.errors import SceneError
from rig.core.results.response import Response

NATURAL, DAMPING, TIME_CONSTANT = 40.0, 0.004, 0.5


def windowed_modes() -> Modes:
    """Identify the mode of a decay that is multiplied by exp(-t / TIME_CONSTANT)."""
    rate, omega = 4096.0, 2 * np.pi * NATURAL
    time, damped = np.arange(1 << 16) / rate, omega * np.sqrt(1 - DAMPING**2)
    decay = np.exp(-DAMPING * omega * time) * np.sin(damped * time) * np.exp(-time / TIME_CONSTANT) / damped
    frequency, value = np.fft.rfftfreq(time.size, 1 / rate), np.fft.rfft(decay) / rate
    lines = (frequency > 20.0) & (frequency < 80.0)
    return analysis.identify([Response.curve(frequency[lines], value[lines], "a1")])


def test_damping_of_exponential_window_is_removed() -> None:
    windowed = windowed_modes()
    modes = windowed.without_exponential_window(TIME_CONSTANT)
    assert windowed.damping[0] == pytest.approx(0.012, rel=0.01)
    assert abs(modes.damping[0] - DAMPING) < 2 * modes.damping_std[0] < 2e-4
    assert modes.frequency[0] == pytest.approx(NATURAL, rel=1e-5)
    assert "exponential window (time constant 0.5 s) is removed" in modes.warnings[-1]


@pytest.mark.parametrize(("time_constant", "message"), [(0.1, "alone gives a damping ratio of 4"), (0.0, "above 0 s")])
def test_impossible_time_constant_is_refused(time_constant: float, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        windowed_modes().without_exponential_window(time_constant)
