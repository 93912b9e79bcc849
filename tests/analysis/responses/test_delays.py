"""Late channels are named by the phases of their modes; damping, nonproportional damping and single modes are not."""

import numpy as np
import pytest

from analysis.core.responses.checks.delays import delayed_channels
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

FREQUENCY = np.arange(10.0, 120.0, 0.5)  # Hz
MASSES = np.array([1.2, 0.7, 0.9, 0.4])  # kg
SPRINGS = np.array([40e3, 25e3, 30e3, 18e3])  # N/m


def chain(values: Array) -> Array:
    return np.diag(values + np.append(values[1:], 0.0)) - np.diag(values[1:], 1) - np.diag(values[1:], -1)


def compliances(damping: Array, frequency: Array = FREQUENCY) -> ComplexArray:
    """Return the compliances of four bodies on body 1, shape (n, 4); modes at 13.5, 34.6, 47 and 54 Hz."""
    omega = 2.0 * np.pi * frequency[:, None, None]
    stiffness = chain(SPRINGS) + 1j * omega * damping - omega**2 * np.diag(MASSES)
    return np.asarray(np.linalg.inv(stiffness)[:, :, 0])


def curves_of(value: ComplexArray, delays: dict[int, float], frequency: Array = FREQUENCY) -> list[Response]:
    """Return responses of the bodies 1, 2, and so on, with delays in s and noise of 0.1 %."""
    random = np.random.default_rng(1)
    curves = []
    for body, row in enumerate(value.T, 1):
        error = 1e-3 * abs(row)
        noise = error * (random.standard_normal(row.size) + 1j * random.standard_normal(row.size))
        late = (row + noise) * np.exp(-2j * np.pi * frequency * delays.get(body, 0.0))
        freedom = np.full(row.size, 38.0)
        curves.append(Response.curve(frequency, late, f"body{body}", error=error, degrees_of_freedom=freedom))
    return curves


STIFFNESS_PROPORTIONAL = 2.0 * 0.01 / (2.0 * np.pi * 13.5) * chain(SPRINGS)


@pytest.mark.parametrize(("body", "delay_s", "text"), [(1, 2e-3, "ms late"), (3, -1e-3, "ms early")])
def test_late_response_is_named(body: int, delay_s: float, text: str) -> None:
    warning = delayed_channels(curves_of(compliances(STIFFNESS_PROPORTIONAL), {body: delay_s}), "the force")
    assert warning.startswith(f"body{body} seems to be ({1e3 * abs(delay_s):.2g}") and text in warning


def test_failed_channel_hides_no_late_channel() -> None:
    *valid, last = curves_of(compliances(STIFFNESS_PROPORTIONAL), {2: 2e-3})
    failed = last.scaled(np.zeros(FREQUENCY.size))
    assert delayed_channels([*valid, failed], "the force").startswith("body2 seems to be (2")


def test_late_force_makes_all_responses_early() -> None:
    delays = dict.fromkeys(range(1, 5), -2e-3)
    warning = delayed_channels(curves_of(compliances(STIFFNESS_PROPORTIONAL), delays), "f2")
    assert warning.startswith("f2 seems to be (2.0")


def test_delay_of_single_response_is_ambiguous() -> None:
    curves = curves_of(compliances(STIFFNESS_PROPORTIONAL), {2: 2e-3})[1:2]
    assert "body2 seems to be (2.0" in (warning := delayed_channels(curves, "the force"))
    assert "or the force early" in warning


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rounding_errors_change_no_delay(seed: int) -> None:
    # The phase of a single late curve looks like a pole far above the band.
    [curve] = curves_of(compliances(STIFFNESS_PROPORTIONAL), {1: 2e-3})[:1]
    rounding = 1e-13 * np.random.default_rng(seed).standard_normal(FREQUENCY.size)
    variants = [curve, curve.scaled(1.0 + rounding)]
    first, second = (delayed_channels([each], "the force") for each in variants)
    assert first == second and first.startswith("body1 seems to be (2.0")


def test_delay_is_determined_by_few_points() -> None:
    frequency = np.linspace(8.0, 64.0, 24)
    curves = curves_of(compliances(STIFFNESS_PROPORTIONAL, frequency), {2: 2e-3}, frequency)
    assert delayed_channels(curves, "the force").startswith("body2 seems to be (2.")


@pytest.mark.parametrize("dashpot", range(4))
def test_dashpot_at_one_spring_is_no_delay(dashpot: int) -> None:
    values = np.zeros(4)
    values[dashpot] = 12.0  # N s/m
    damping = chain(values) + 0.1 * STIFFNESS_PROPORTIONAL
    assert not delayed_channels(curves_of(compliances(damping), {}), "the force")


def test_different_delays_are_not_reported() -> None:
    curves = curves_of(compliances(STIFFNESS_PROPORTIONAL), {1: 2e-3, 2: -1e-3})
    assert not delayed_channels(curves, "the force")


@pytest.mark.parametrize("damping", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("width", [2.0, 8.0, 20.0])
def test_damped_mode_in_narrow_band_is_no_delay(damping: float, width: float) -> None:
    frequency = np.linspace(50.0 - width / 2.0, 50.0 + width / 2.0, 81)
    value = 1.0 / (1.0 - (frequency / 50.0) ** 2 + 2j * damping * frequency / 50.0)
    curves = [
        Response.curve(frequency, sign * value, name, error=1e-3 * abs(value), degrees_of_freedom=np.full(81, 38.0))
        for name, sign in (("body1", 1.0), ("body2", 0.8), ("body3", -1.0))
    ]
    assert not delayed_channels(curves, "the force")


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
    assert not delayed_channels([curve], "the force")


def single_mode(frequency: Array, damping: float, base: float) -> ComplexArray:
    """Return the response of a mode at 25 Hz to a force, or with `base` = 1 to a table with a dashpot."""
    ratio = frequency / 25.0
    dashpot = 2j * damping * ratio
    return np.asarray((1.0 + base * dashpot) / (1.0 - ratio**2 + dashpot))


def test_late_response_of_single_mode_is_named() -> None:
    value = np.stack([single_mode(FREQUENCY, 0.01, 0.0) * shape for shape in (1.0, 0.6)], axis=1)
    assert delayed_channels(curves_of(value, {2: 2e-3}), "the force").startswith("body2 seems to be (2")


@pytest.mark.parametrize("damping", [0.15, 0.2])
def test_dashpot_to_table_is_no_delay(damping: float) -> None:
    frequency = np.linspace(20.0, 31.0, 151)
    curves = curves_of(single_mode(frequency, damping, 1.0)[:, None], {}, frequency)
    assert not delayed_channels(curves, "table")
