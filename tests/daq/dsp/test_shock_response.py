"""Extremes of oscillators on a moving base, compared with closed form."""

import numpy as np
import pytest

from daq.core.dsp.shock_response import shock_response
from rig.core.base.arrays import Array


def half_sine_response(frequency: float, q: float, width: float) -> tuple[float, float]:
    """Return the extremes of the absolute acceleration of an oscillator whose base moves by sin(pi t / width)."""
    omega, zeta, forcing = 2 * np.pi * frequency, 0.5 / q, np.pi / width
    # Relative motion z: particular solution of z'' + 2 zeta omega z' + omega^2 z = -sin(forcing t).
    particular = -1.0 / (omega**2 - forcing**2 + 2j * zeta * omega * forcing)
    root = complex(-zeta * omega, omega * np.sqrt(1 - zeta**2))

    def free(time: Array, z: float, v: float) -> tuple[Array, Array]:
        amplitude = z - 1j * (v + zeta * omega * z) / root.imag
        motion = amplitude * np.exp(root * time)
        return motion.real, (root * motion).real

    time = np.linspace(0.0, width, 40001)
    forced = particular * np.exp(1j * forcing * time)
    start = particular * np.array([1.0, 1j * forcing])
    z, v = free(time, -start[0].imag, -start[1].imag)
    z, v = z + forced.imag, v + (1j * forcing * forced).imag
    after = free(np.linspace(0.0, 1.0 / frequency, 40001), float(z[-1]), float(v[-1]))
    acceleration = -(2 * zeta * omega * np.append(v, after[1]) + omega**2 * np.append(z, after[0]))
    return float(acceleration.max()), float(acceleration.min())


@pytest.mark.parametrize("q", [5.0, 10.0, 50.0])
@pytest.mark.parametrize("rate", [5120.0, 51200.0])
def test_half_sine_agrees_with_closed_form(q: float, rate: float) -> None:
    width, frequency = 11e-3, np.geomspace(5.0, 1000.0, 40)
    time = np.arange(int(width * rate) + 1) / rate
    computed = shock_response(np.sin(np.pi * time / width), rate, frequency, q)
    exact = np.array([half_sine_response(f, q, width) for f in frequency]).T
    assert computed[0] == pytest.approx(exact[0], rel=5e-3)
    assert computed[1] == pytest.approx(exact[1], rel=5e-3, abs=5e-3)


def test_stiff_oscillator_follows_its_base() -> None:
    time = np.arange(4096) / 4096.0
    motion = np.sin(2 * np.pi * 3.0 * time) * np.sin(np.pi * time) ** 2
    largest, smallest = shock_response(motion, 4096.0, np.array([800.0]), 10.0)
    assert largest[0] == pytest.approx(motion.max(), rel=1e-3)
    assert smallest[0] == pytest.approx(motion.min(), rel=1e-3)
