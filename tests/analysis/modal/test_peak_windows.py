"""Modes of curves without stated errors come from windows around peaks, and do not depend on the rest of the band."""

import numpy as np

import analysis
from analysis.core.modal.peak_windows import peak_windows
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

FREQUENCY = np.arange(10.0, 400.0, 0.5)


def accelerance(frequency: Array, echo: float = 0.0) -> ComplexArray:
    s, value = 2j * np.pi * frequency, np.zeros(frequency.size, dtype=complex)
    for natural, damping in ((110.0, 0.01), (170.0, 0.008)):
        omega = 2 * np.pi * natural
        value += s**2 / (s**2 + 2 * damping * omega * s + omega**2)
    return value * (1.0 + echo * np.exp(-0.05 * s))


def measured(frequency: Array, echo: float = 0.0) -> Response:
    """Return a curve as a text file gives it: with noise and without errors; noise only above 250 Hz."""
    random = np.random.default_rng(1)
    noise = random.standard_normal(FREQUENCY.size) + 1j * random.standard_normal(FREQUENCY.size)
    noise *= np.where(FREQUENCY > 250.0, 3.0, 3e-3)
    value = accelerance(FREQUENCY, echo) + noise
    chosen = np.isin(FREQUENCY, frequency)
    return Response.curve(FREQUENCY[chosen], value[chosen], "a1", motion="acceleration")


def limits(frequency: Array) -> list[tuple[float, float]]:
    curve = measured(frequency).to("displacement")
    return [
        (float(curve.frequency[window.first]), float(curve.frequency[window.stop - 1]))
        for window in peak_windows(curve.frequency, [curve.value])
    ]


def test_each_peak_has_its_window() -> None:
    (low, high), (other_low, other_high) = limits(FREQUENCY)
    assert low < 110.0 < high < other_high and other_low < 170.0 < other_high


def test_windows_do_not_depend_on_band() -> None:
    assert limits(FREQUENCY) == limits(FREQUENCY[(FREQUENCY > 60.0) & (FREQUENCY < 230.0)])


def test_band_without_peak_is_one_window() -> None:
    frequency = FREQUENCY[FREQUENCY > 250.0]
    assert limits(frequency) == [(frequency[0], frequency[-1])]


def test_limits_far_from_peaks_leave_modes_equal() -> None:
    all_lines, band = (
        analysis.identify([measured(FREQUENCY[selected])])
        for selected in (FREQUENCY > 0.0, (FREQUENCY > 60.0) & (FREQUENCY < 230.0))
    )
    assert all_lines.frequency.size == 2
    np.testing.assert_array_equal(all_lines.frequency, band.frequency)
    np.testing.assert_array_equal(all_lines.damping_std, band.damping_std)


def test_ripple_of_echo_is_not_modes() -> None:
    modes = analysis.identify([measured(FREQUENCY[FREQUENCY < 250.0], echo=0.03)])
    np.testing.assert_allclose(modes.frequency, [110.0, 170.0], rtol=2e-3)


def test_sum_of_modes_and_residual_terms_follows_curve() -> None:
    frequency = FREQUENCY[(FREQUENCY > 60.0) & (FREQUENCY < 230.0)]
    receptance = analysis.identify([measured(frequency)]).receptance(frequency)[0]
    expected = accelerance(frequency) / (2j * np.pi * frequency) ** 2
    assert np.median(abs(receptance - expected) / abs(expected)) < 0.02


def test_count_selects_highest_peaks() -> None:
    (frequency,) = analysis.identify([measured(FREQUENCY)], count=1).frequency
    assert abs(frequency - 170.0) < 0.1


def test_long_window_is_thinned() -> None:
    frequency = np.arange(60.0, 230.0, 0.01)
    curve = Response.curve(frequency, accelerance(frequency) + 1e-4, "a1", motion="acceleration")
    np.testing.assert_allclose(analysis.identify([curve]).frequency, [110.0, 170.0], rtol=1e-4)


def test_band_may_have_many_peaks() -> None:
    frequency, natural = np.arange(10.0, 2000.0, 0.5), np.arange(100.0, 1900.0, 20.0)
    value = (1.0 / (natural[:, None] ** 2 - frequency**2 + 2j * frequency)).sum(axis=0)

    windows_of_peaks = peak_windows(frequency, [value])

    assert [sum(window.low < each < window.high for window in windows_of_peaks) for each in natural] == [1] * 90
    assert len(windows_of_peaks) == 90


def test_flank_of_another_mode_does_not_widen_window() -> None:
    # A peak of mains hum on the flank of the first mode.
    value = accelerance(FREQUENCY) * (1.0 + 0.25 * (FREQUENCY == 130.0))
    windows = peak_windows(FREQUENCY, [value / FREQUENCY**2])
    assert [window.stop - window.first for window in windows] == [41, 41, 41]


def compliance(*modes: tuple[float, float, float]) -> ComplexArray:
    """Return a compliance of modes, each of a natural frequency in Hz, a damping ratio and a factor."""
    s, value = 2j * np.pi * FREQUENCY, np.zeros(FREQUENCY.size, dtype=complex)
    for natural, damping, factor in modes:
        omega = 2 * np.pi * natural
        value += factor / (s**2 + 2 * damping * omega * s + omega**2)
    return value


def test_wide_and_narrow_peaks_have_separate_windows() -> None:
    wide, narrow = peak_windows(FREQUENCY, [compliance((150.0, 0.2, 1.0), (220.0, 0.002, 1.0))])
    assert narrow.stop - narrow.first == 41 and FREQUENCY[wide.stop - 1] > 280.0


def test_overlapping_windows_contain_limit_between_modes() -> None:
    # The lowest line between the peaks is at 125 Hz, outside of the lower window.
    low, high = peak_windows(FREQUENCY, [compliance((110.0, 0.01, 1.0), (126.0, 0.002, 0.05))])
    assert FREQUENCY[high.first] <= low.high == high.low <= FREQUENCY[low.stop - 1]
