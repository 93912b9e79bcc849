"""Poles of a band are compared with those of its parts: differences add uncertainty, unconfirmed poles are left out."""

import numpy as np
import pytest
from numpy.typing import NDArray

import analysis
from analysis.core.modal.band_choice import band_choice, parts_of_band
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response

FREQUENCY = np.arange(50.0, 200.0, 0.5)


def poles_at(natural: list[float], damping: float = 0.02) -> ComplexArray:
    return 2 * np.pi * np.array(natural) * complex(-damping, np.sqrt(1 - damping**2))


def test_parts_omit_ends_and_every_second_line() -> None:
    parts = [(FREQUENCY[lines[0]], FREQUENCY[lines[-1]], step) for lines, step in parts_of_band(FREQUENCY)]
    assert parts == [(80.0, 199.5, 1), (50.0, 169.5, 1), (50.0, 199.0, 2), (50.5, 199.5, 2)]


def test_differences_between_parts_add_uncertainty() -> None:
    shifts = iter([0.2, -0.2, 0.2, -0.2])

    choice = band_choice(FREQUENCY, poles_at([100.0]), lambda _: poles_at([100.0 + next(shifts)], 0.021))

    assert choice.confirmed.all()
    assert choice.frequency_error[0] == pytest.approx(1.2 * 0.2)
    assert choice.damping_error[0] == pytest.approx(0.0012)


def test_pole_of_half_of_the_parts_is_rejected() -> None:
    parts = iter([[100.0, 130.0], [100.0, 130.0], [100.0], [100.0]])

    choice = band_choice(FREQUENCY, poles_at([100.0, 130.0]), lambda _: poles_at(next(parts)))

    assert choice.confirmed.tolist() == [True, False]


def test_mode_next_to_limit_needs_no_confirmation() -> None:
    def identify(lines: NDArray[np.intp]) -> ComplexArray:
        if FREQUENCY[lines[0]] > 60.0:
            raise RecordingError("no mode")
        return poles_at([60.0])

    assert band_choice(FREQUENCY, poles_at([60.0]), identify).confirmed.all()


def _with_echo(frequency: Array) -> Response:
    """Return an accelerance of two modes with an echo of the force, as a text file gives it: without errors."""
    s, value = 2j * np.pi * frequency, np.zeros(frequency.size, dtype=complex)
    for natural, damping in ((110.0, 0.02), (160.0, 0.01)):
        omega = 2 * np.pi * natural
        value += s**2 / (s**2 + 2 * damping * omega * s + omega**2)
    return Response.curve(frequency, value * (1.0 + 0.03 * np.exp(-0.02 * s)), "a1", motion="acceleration")


@pytest.mark.parametrize(("low", "high"), [(60.0, 240.0), (72.0, 240.0), (60.0, 200.0)])
def test_intervals_of_bands_contain_modes_of_all_lines(low: float, high: float) -> None:
    frequency = np.arange(30.0, 300.0, 0.4)
    inside = (frequency >= low) & (frequency <= high)

    all_lines, band = (analysis.identify([_with_echo(lines)]) for lines in (frequency, frequency[inside]))

    assert all_lines.frequency.size == band.frequency.size == 2
    assert (
        abs(all_lines.frequency - band.frequency) < 2 * np.hypot(all_lines.frequency_error, band.frequency_error)
    ).all()
    assert (abs(all_lines.damping - band.damping) < 2 * np.hypot(all_lines.damping_error, band.damping_error)).all()


def test_peak_narrower_than_lines_is_confirmed() -> None:
    choice = band_choice(FREQUENCY, poles_at([120.0], 1e-9), lambda _: poles_at([120.1], 1e-9))

    assert choice.confirmed.all()
    assert choice.frequency_error[0] == pytest.approx(1.2 * 0.1)
