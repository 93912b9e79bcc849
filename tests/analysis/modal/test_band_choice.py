"""Poles of a band are compared with those of its parts: differences add uncertainty, unconfirmed poles are omitted."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import analysis
from analysis.core.modal import window_fits
from analysis.core.modal.band_choice import BandChoice, band_choice, parts_of_band
from analysis.core.modal.modal_fit import MODEL_ERRORS, fit_modes
from analysis.core.modal.pole_residue import Curves, fit
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


def test_pole_missing_without_an_end_is_rejected() -> None:
    parts = iter([[100.0, 130.0], [100.0], [100.0, 130.0], [100.0, 130.0]])

    choice = band_choice(FREQUENCY, poles_at([100.0, 130.0]), lambda _: poles_at(next(parts)))

    assert choice.confirmed.tolist() == [True, False]


def test_one_half_of_lines_confirms_pole() -> None:
    parts = iter([[100.0, 130.0], [100.0, 130.0], [100.0], [100.0, 130.0]])

    choice = band_choice(FREQUENCY, poles_at([100.0, 130.0]), lambda _: poles_at(next(parts)))

    assert choice.confirmed.all()


def test_pole_of_part_belongs_to_nearest_pole() -> None:
    parts = iter([[100.0, 103.0], [100.0, 103.0], [101.4], [101.4]])

    choice = band_choice(FREQUENCY, poles_at([100.0, 103.0], 0.016), lambda _: poles_at(next(parts), 0.016))

    assert choice.confirmed.tolist() == [True, False]
    assert choice.frequency_error[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("bandwidth", "is_confirmed"), [(1.6, True), (2.4, False)])
def test_halves_confirm_poles_that_they_resolve(bandwidth: float, is_confirmed: bool) -> None:
    parts = iter([[100.0], [100.0], [], []])
    damping = 0.5 * bandwidth / 100.0

    choice = band_choice(FREQUENCY, poles_at([100.0], damping), lambda _: poles_at(next(parts), damping))

    assert choice.confirmed.tolist() == [is_confirmed]


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


def test_parts_may_need_larger_model_error(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, needed = [], []

    def record(curves: list[Response], count: int | None = None, errors: tuple[float, ...] = MODEL_ERRORS) -> object:
        fitted = fit_modes(curves, count, errors)
        tried.append(list(errors))
        needed.append(fitted.assumed_error)
        return fitted

    monkeypatch.setattr(window_fits, "fit_modes", record)
    curve = _with_echo(np.arange(80.0, 135.0, 0.4))
    analysis.identify([replace(curve, value=curve.value * (1.0 + 0.1 * np.cos(curve.frequency)))])

    assert 0.0 < needed[0] < MODEL_ERRORS[-1]
    assert tried[1] == [error for error in MODEL_ERRORS if error >= needed[0]]


@pytest.mark.parametrize(("n_lines", "n_modes"), [(FREQUENCY.size, 1), (2 * FREQUENCY.size, 0)])
def test_pole_wider_than_window_is_rejected(n_lines: int, n_modes: int) -> None:
    s, omega = 2j * np.pi * FREQUENCY, 2 * np.pi * 180.0
    curve = Response.curve(FREQUENCY, 1.0 / (s**2 + 0.4 * omega * s + omega**2), "a1")
    window = window_fits.Window(0, FREQUENCY.size, 0.0, np.inf)

    assert window_fits._identify_window([curve], window, n_lines).poles.size == n_modes


def test_pole_of_uncertain_frequency_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    s, omega = 2j * np.pi * FREQUENCY, 2 * np.pi * 120.0
    curve = Response.curve(FREQUENCY, 1.0 / (s**2 + 0.06 * omega * s + omega**2), "a1")
    assert analysis.identify([curve]).frequency.size == 1
    # Its half-width is 3.6 Hz.
    exact = window_fits.band_choice

    def shifted(*arguments: Any) -> BandChoice:
        return exact(*arguments)._replace(frequency_error=np.array([1.2]))

    monkeypatch.setattr(window_fits, "band_choice", shifted)
    with pytest.raises(RecordingError, match="Rejected the poles at 120 Hz"):
        analysis.identify([curve])


def test_fewer_residuals_than_parameters_are_fitted() -> None:
    frequency = np.array([10.0, 12.0, 14.0, 16.0, 18.0, 20.0])
    value = 1.0 / (frequency - 15.0 + 0.5j)[None]

    model = fit(Curves(frequency, value, np.ones((1, 6))), poles_at([11.0, 15.0, 19.0]))

    assert np.isfinite(model.poles).all()
