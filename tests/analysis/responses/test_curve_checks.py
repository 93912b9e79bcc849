"""A reversed force is detected from the driving-point response, which would supply energy; delay and noise are not."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.core.responses.checks import curve_checks
from analysis.core.responses.checks.curve_checks import delayed_channels, find_jumps, reversed_force
from rig.core.results.points import Point
from rig.core.results.response import Response
from tests.peak_memory import peak_memory

MASS, STIFFNESS = np.diag([4.2, 1.1]), np.array([[1.8e6, -0.9e6], [-0.9e6, 0.9e6]])
FREQUENCY = np.arange(20.0, 300.0, 0.5)  # Hz


def measured(response: int = 1, *, grounded: bool = True, noise: float = 1e-3) -> Response:
    """Return the receptance of two bodies, with modes at 64 and 166 Hz, to a force on body 1; `noise` is relative."""
    stiffness = STIFFNESS if grounded else STIFFNESS - np.diag([0.9e6, 0.0])
    value = np.array(
        [np.linalg.inv(stiffness * (1 + 0.016j) - (2 * np.pi * f) ** 2 * MASS)[response - 1, 0] for f in FREQUENCY]
    )
    random, error = np.random.default_rng(response), noise * abs(value)
    value += error * (random.standard_normal(FREQUENCY.size) + 1j * random.standard_normal(FREQUENCY.size))
    return Response.curve(
        FREQUENCY, value, f"body{response}", error=error, degrees_of_freedom=np.full(FREQUENCY.size, 38.0),
        output_at=f"body {response}", input_at="body 1",
    )  # fmt: skip


@pytest.mark.parametrize("motion", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("grounded", [True, False])
def test_reversed_force_is_reported_once(motion: str, grounded: bool) -> None:
    curves = [replace(curve, value=-curve.value) for curve in (measured(1, grounded=grounded), measured(2))]
    warning = reversed_force([curve.to(motion) for curve in curves])
    assert "body1 / force at body 1" in warning and "sign: -1" in warning and "body2" not in warning


@pytest.mark.parametrize("delay_s", [0.0, 20e-6, 1e-3, -1e-3])
@pytest.mark.parametrize("noise", [1e-4, 0.05, 1.0])
def test_delay_and_noise_do_not_reverse_force(delay_s: float, noise: float) -> None:
    for grounded in (True, False):
        curve = measured(1, grounded=grounded, noise=noise)
        delayed = replace(curve, value=curve.value * np.exp(-2j * np.pi * FREQUENCY * delay_s))
        assert not reversed_force([delayed])


@pytest.mark.parametrize("damping", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("width", [2.0, 8.0, 20.0])
def test_damped_mode_in_narrow_band_is_no_delay(damping: float, width: float) -> None:
    frequency = np.linspace(50.0 - width / 2.0, 50.0 + width / 2.0, 81)
    value = 1.0 / (1.0 - (frequency / 50.0) ** 2 + 2j * damping * frequency / 50.0)
    curves = [
        Response.curve(frequency, sign * value, name, error=1e-3 * abs(value), degrees_of_freedom=np.full(81, 38.0))
        for name, sign in (("body1", 1.0), ("body2", 0.8), ("body3", -1.0))
    ]
    assert not delayed_channels(curves)


@pytest.mark.parametrize("highest", [180.0, 220.0])
def test_damping_above_resonances_is_no_delay(highest: float) -> None:
    # Above the last mode at 80 Hz, the forces of modal damping turn the phase of a distant body steadily to 90 degrees.
    masses, springs = (
        np.array([0.603, 0.557, 2.9, 0.498, 0.323]),
        np.array([73900.0, 21100.0, 72300.0, 58000.0, 17800.0]),
    )
    stiffness = np.diag(springs + np.append(springs[1:], 0.0)) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)
    square, shapes = np.linalg.eigh(stiffness / np.sqrt(np.outer(masses, masses)))
    frequency, ratios = np.arange(1.75, highest, 0.5), np.array([0.02, 0.029, 0.013, 0.014, 0.03])
    omega = 2.0 * np.pi * frequency[:, None]
    value = (shapes[1] * shapes[4] / (square - omega**2 + 2j * ratios * np.sqrt(square) * omega)).sum(axis=1)
    curve = Response.curve(frequency, value, "body2", error=1e-3 * abs(value))
    assert not delayed_channels([curve])


def test_delay_in_narrow_band_without_mode_is_named() -> None:
    frequency = np.linspace(80.0, 120.0, 81)
    value = np.exp(-2j * np.pi * frequency * 5e-3)
    curve = Response.curve(frequency, value, "body1", error=np.full(81, 1e-3), degrees_of_freedom=np.full(81, 38.0))
    assert "body1 seems to be 5 ms late" in delayed_channels([curve])


def test_late_force_among_several_is_named() -> None:
    delay = np.exp(2j * np.pi * FREQUENCY * 2e-3)
    curves = [
        replace(curve, value=curve.value * delay, inputs=(Point("f2", "force"),))
        for curve in (measured(1), measured(2))
    ]
    assert delayed_channels(curves).startswith("f2 seems to be 2 ms late")


def test_other_responses_may_have_any_phase() -> None:
    curve = measured(2)
    assert not reversed_force([curve, replace(curve, value=-curve.value)])


def test_uncertain_points_are_ignored() -> None:
    curve = measured(1, noise=0.5)
    assert not reversed_force([replace(curve, value=-curve.value)])


def test_delay_of_long_curve_needs_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curve_checks, "_MAX_LINES", 100)
    peaks = []
    for lines in (4000, 8000):
        frequency = np.linspace(20.0, 300.0, lines)
        value = np.exp(-2j * np.pi * 1e-3 * frequency)
        curve = Response.curve(
            frequency,
            value,
            "body1",
            error=np.full(lines, 1e-4),
            degrees_of_freedom=np.full(lines, 38.0),
            reference="force",
        )
        peak, warning = peak_memory(delayed_channels, [curve])
        assert "1 ms" in warning
        peaks.append(peak)
    assert peaks[1] < 2.0 * peaks[0] < 0.1 * 16 * curve_checks._TRIAL_DELAYS * lines


@pytest.mark.parametrize(("noise", "jumps"), [(1e-3, [(11.5, "jump down")]), (0.32, [])])
def test_step_within_noise_is_not_a_jump(noise: float, jumps: list[tuple[float, str]]) -> None:
    frequency = np.arange(10.0, 14.0)
    value = np.array([170e-6, 167e-6, 28e-6, 28e-6], dtype=complex)
    error = np.array([1e-8, 1e-8, noise * 28e-6, 1e-8])
    curve = Response.curve(frequency, value, "body1", error=error, degrees_of_freedom=np.full(4, 130.0))
    assert find_jumps(curve) == jumps
