"""Extremes of oscillators on a moving base, compared with closed form."""

import numpy as np
import pytest
from scipy import signal

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
@pytest.mark.parametrize(
    ("width", "rate", "after"), [(3e-3, 5120.0, 0.012), (11e-3, 5120.0, 3e-3), (11e-3, 51200.0, 3e-3)]
)
def test_half_sine_agrees_with_closed_form(q: float, width: float, rate: float, after: float) -> None:
    frequency = np.geomspace(5.0, 1000.0, 40)
    time = np.arange(int(width * rate) + 1) / rate
    computed = shock_response([np.sin(np.pi * time / width)], rate, frequency, q)
    exact = np.array([half_sine_response(f, q, width) for f in frequency]).T
    assert computed[0] == pytest.approx(exact[0], rel=1e-3)
    # The samples do not define where the pulse ends after its last sample, which changes the later motion.
    assert computed[1] == pytest.approx(exact[1], abs=after)


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("highest", [0.1, 0.2, 0.3])
def test_filtered_half_sine_agrees_with_closed_form(offset: float, highest: float) -> None:
    # Fifteen samples in the pulse, behind an anti-aliasing filter; `offset`: from a sample to the start of the pulse.
    samples, oversampling, before = 15.0, 32, 100
    time = (np.arange(216 * oversampling) / oversampling - before + offset) / samples
    pulse = np.where((time > 0.0) & (time < 1.0), np.sin(np.pi * time), 0.0)
    taps = signal.firwin(128 * oversampling + 1, 0.9, window=("kaiser", 10.0), fs=2.0 * oversampling)
    measured = signal.fftconvolve(pulse, taps, "same")[::oversampling]
    frequency = np.geomspace(0.05, highest * samples, 20)
    exact = np.array([half_sine_response(f, 50.0, 1.0) for f in frequency]).T
    computed = shock_response([measured], samples, frequency, 50.0)
    assert computed[0] == pytest.approx(exact[0], rel=3e-3)
    assert computed[1] == pytest.approx(exact[1], abs=5e-3)


@pytest.mark.parametrize("highest", [50.0, 400.0])
def test_gap_gives_no_extremes(highest: float) -> None:
    motion = np.ones(3000)
    motion[1500] = np.nan
    assert np.isnan(shock_response([motion], 1000.0, np.array([10.0, highest]), 10.0)).all()


def test_stiff_oscillator_follows_its_base() -> None:
    time = np.arange(4096) / 4096.0
    motion = np.sin(2 * np.pi * 3.0 * time) * np.sin(np.pi * time) ** 2
    largest, smallest = shock_response([motion], 4096.0, np.array([800.0]), 10.0)
    assert largest[0] == pytest.approx(motion.max(), rel=1e-3)
    assert smallest[0] == pytest.approx(motion.min(), rel=1e-3)


def test_impacts_agree_with_finely_sampled_motion() -> None:
    # Pulses behind an anti-aliasing filter, whose band ends at 0.45 of the sample rate, at random times.
    random = np.random.default_rng(3)
    instant, size = random.uniform(50.0, 950.0, 12), random.normal(0.0, 1.0, 12)

    def motion(oversampling: int) -> Array:
        time = np.arange(1000 * oversampling)[:, None] / oversampling - instant
        return (np.sinc(0.8 * time) * np.exp(-((time / 10.0) ** 2))) @ size

    frequency = np.geomspace(0.01, 0.2, 40)
    computed, fine = (shock_response([motion(n)], float(n), frequency, 10.0) for n in (1, 32))
    assert computed[0] == pytest.approx(fine[0], rel=2e-3)
    assert computed[1] == pytest.approx(fine[1], rel=2e-3)


def test_pieces_give_same_spectrum(monkeypatch: pytest.MonkeyPatch) -> None:
    motion, frequency = np.random.default_rng(1).standard_normal(3000), np.geomspace(5.0, 300.0, 10)
    for rate in (1000.0, 20_000.0):
        whole = shock_response([motion], rate, frequency, 10.0)
        with monkeypatch.context() as patch:
            patch.setattr("daq.core.dsp.shock_response._PIECE_SAMPLES", 200)
            assert np.array_equal(shock_response([motion], rate, frequency, 10.0), whole)


@pytest.mark.parametrize("samples", [6, 20, 30])
def test_short_motion_is_complete(samples: int) -> None:
    motion = np.zeros(100)
    motion[:6] = np.sin(np.pi * np.arange(6) / 5.0)
    frequencies = np.array([200.0, 300.0])
    short, long = (shock_response([values], 1000.0, frequencies, 10.0) for values in (motion[:samples], motion))
    np.testing.assert_allclose(short, long, rtol=1e-9)
