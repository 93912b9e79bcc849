"""Differences between poles of parts of the lines add uncertainty; poles that a part lacks are uncertain."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import analysis
from analysis.core.modal import window_fits
from analysis.core.modal.band_choice import BandChoice, Part, band_choice, end_parts, half_parts
from analysis.core.modal.modal_fit import MODEL_ERRORS, fit_modes
from analysis.core.modal_models.lscf import ChartPole
from analysis.core.modal_models.pole_residue import Curves, fit
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response

FREQUENCY = np.arange(50.0, 200.0, 0.5)


def poles_at(natural: list[float], damping: float = 0.02) -> ComplexArray:
    return 2 * np.pi * np.array(natural) * complex(-damping, np.sqrt(1 - damping**2))


def parts_of(*poles: list[float], damping: float = 0.02) -> list[Part]:
    """Return parts with poles at frequencies in Hz."""
    return [Part(f"part {k}", poles_at(each, damping), 50.0, 199.5, 1.0) for k, each in enumerate(poles)]


def test_parts_omit_ends_and_every_second_line() -> None:
    chosen: list[NDArray[np.intp]] = []

    def identify(lines: NDArray[np.intp]) -> ComplexArray:
        chosen.append(lines)
        return poles_at([])

    parts = [*end_parts(FREQUENCY, identify), *half_parts(FREQUENCY, identify)]

    limits = [(FREQUENCY[lines[0]], FREQUENCY[lines[-1]], lines[1] - lines[0]) for lines in chosen]
    assert limits == [(80.0, 199.5, 1), (50.0, 169.5, 1), (50.0, 199.0, 2), (50.5, 199.5, 2)]
    assert [part.spacing for part in parts] == [0.5, 0.5, 1.0, 1.0]


def test_differences_between_parts_add_uncertainty() -> None:
    parts = parts_of(*([100.0 + shift] for shift in (0.2, -0.2, 0.2, -0.2)), damping=0.021)

    choice = band_choice(poles_at([100.0]), parts)

    assert choice.missing == ((),)
    assert choice.frequency_std[0] == pytest.approx(1.2 * 0.2)
    assert choice.damping_std[0] == pytest.approx(0.0012)


def test_parts_that_lack_a_pole_are_named() -> None:
    parts = parts_of([100.0, 130.0], [100.0], [100.0, 130.0], [100.0])
    assert band_choice(poles_at([100.0, 130.0]), parts).missing == ((), ("part 1", "part 3"))


def test_pole_of_part_belongs_to_nearest_pole() -> None:
    choice = band_choice(poles_at([100.0, 103.0], 0.016), parts_of([100.0, 103.0], [101.4], damping=0.016))

    assert choice.missing == ((), ("part 1",))
    assert choice.frequency_std[1] == pytest.approx(0.0, abs=1e-9)


def test_mode_next_to_end_of_window_is_not_expected() -> None:
    def identify(lines: NDArray[np.intp]) -> ComplexArray:
        if FREQUENCY[lines[0]] > 60.0:
            raise RecordingError("no mode")
        return poles_at([60.0])

    assert band_choice(poles_at([60.0]), [*end_parts(FREQUENCY, identify)]).missing == ((),)


def _peaks(*natural: float, half_power_width: float) -> Response:
    """Return a compliance of modes with noise, as a text file gives it: without errors; lines every 0.5 Hz."""
    s, value, random = 2j * np.pi * FREQUENCY, np.zeros(FREQUENCY.size, dtype=complex), np.random.default_rng(2)
    for f in natural:
        pole = np.pi * complex(-half_power_width, 2.0 * f)
        value += f * half_power_width / ((s - pole) * (s - pole.conjugate()))
    noise = random.standard_normal(FREQUENCY.size) + 1j * random.standard_normal(FREQUENCY.size)
    return Response.curve(FREQUENCY, value + 2e-3 * abs(value).max() * noise, "a1")


@pytest.mark.parametrize("half_power_width", [0.4, 0.7, 1.2, 2.0, 4.0])
def test_modes_of_all_lines_are_listed_for_every_second_line(half_power_width: float) -> None:
    curve = _peaks(90.3, 140.2, half_power_width=half_power_width)

    every, second = (analysis.identify([curve.at(np.arange(0, FREQUENCY.size, step))]) for step in (1, 2))

    listed = [*second.frequency, *(each.frequency for each in second.uncertain)]
    assert every.frequency.size == 2
    assert sorted(listed) == pytest.approx(every.frequency, abs=max(0.5 * half_power_width, 0.1))


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
    assert (abs(all_lines.frequency - band.frequency) < 2 * np.hypot(all_lines.frequency_std, band.frequency_std)).all()
    assert (abs(all_lines.damping - band.damping) < 2 * np.hypot(all_lines.damping_std, band.damping_std)).all()


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
    assert tried[-1] == [error for error in MODEL_ERRORS if error >= needed[0]]


@pytest.mark.parametrize(("n_lines", "n_modes"), [(FREQUENCY.size, 1), (2 * FREQUENCY.size, 0)])
def test_pole_wider_than_window_is_rejected(n_lines: int, n_modes: int) -> None:
    s, omega = 2j * np.pi * FREQUENCY, 2 * np.pi * 180.0
    curve = Response.curve(FREQUENCY, 1.0 / (s**2 + 0.4 * omega * s + omega**2), "a1")
    window = window_fits.Window(0, FREQUENCY.size, 0.0, np.inf)

    assert window_fits._fit_window([curve], window, n_lines).poles.size == n_modes


@pytest.mark.parametrize(
    ("choice", "reason"),
    [
        ({"frequency_std": np.array([1.2])}, r"\(120\.0 ± 2\.4\) Hz \(frequency is uncertain"),
        ({"damping_std": np.array([0.011])}, "damping is uncertain"),
    ],
)
def test_undetermined_pole_is_uncertain(choice: dict[str, Array], reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    s, omega = 2j * np.pi * FREQUENCY, 2 * np.pi * 120.0
    curve = Response.curve(FREQUENCY, 1.0 / (s**2 + 0.06 * omega * s + omega**2), "a1")
    assert analysis.identify([curve]).frequency.size == 1
    # Its half-width is 3.6 Hz, its damping ratio 0.03.
    exact = window_fits.band_choice

    def shifted(*arguments: Any) -> BandChoice:
        return exact(*arguments)._replace(**choice)

    monkeypatch.setattr(window_fits, "band_choice", shifted)
    with pytest.raises(RecordingError, match=f"Uncertain modes: .*{reason}"):
        analysis.identify([curve])


@pytest.mark.parametrize(("n_orders", "known", "n_listed"), [(16, [], 1), (8, [], 0), (16, [121.0], 0)])
def test_stable_pole_without_peak_is_uncertain(n_orders: int, known: list[float], n_listed: int) -> None:
    chart = [ChartPole(order, 120.0 + 0.01 * order, 0.03, order >= 24 - n_orders) for order in range(2, 24)]

    listed = window_fits.stable_without_peak(FREQUENCY, [chart], np.array(known))

    assert len(listed) == n_listed
    for each in listed:
        assert each.frequency == pytest.approx(120.0, abs=0.3) and 0.0 < each.frequency_std < 0.1
        assert each.reason == "no distinct peak"


def test_orders_of_stable_pole_are_counted_once() -> None:
    chart = [ChartPole(order, 120.0 + k, 0.03, order >= 16) for order in range(2, 24) for k in (0.0, 0.1)]
    assert not window_fits.stable_without_peak(FREQUENCY, [chart], np.array([]))


@pytest.mark.parametrize("count", [1, 2])
def test_modes_beyond_count_are_not_uncertain(count: int) -> None:
    modes = analysis.identify([_peaks(70.2, 90.3, 140.2, half_power_width=2.0)], count)
    assert modes.frequency.size == count and not modes.uncertain


def test_fewer_residuals_than_parameters_are_fitted() -> None:
    frequency = np.array([10.0, 12.0, 14.0, 16.0, 18.0, 20.0])
    value = 1.0 / (frequency - 15.0 + 0.5j)[None]

    model = fit(Curves(frequency, value, np.ones((1, 6))), poles_at([11.0, 15.0, 19.0]))

    assert np.isfinite(model.poles).all()
