"""Modes identified from frequency responses: frequency, damping, shapes, and their uncertainties."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy
from matplotlib.figure import Figure

import analysis
import daq
from analysis.commands.presentation.mode_findings import describe_modes
from analysis.core.modal.modal_fit import fit_modes
from analysis.core.modal.pole_errors import LEAKAGE_FACTOR, pole_errors
from analysis.core.modal_models.order_selection import computational_poles
from analysis.core.modal_models.pole_residue import Curves, fit
from analysis.core.responses.errors.systematic import UNSETTLED
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Response
from rig.core.results.uncertainty import SENSITIVITY, UncertaintyBudget
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import structure_matrices
from tests.analysis.responses import synthetic
from tests.gauntlet.band_stability import draw_curves

# Natural frequencies of the synthetic structure with the shaker's spring, rad/s.
OMEGA_WITH_SPRING = np.array([86.776, 228.231, 318.003])
DAMPING = 0.005  # damping ratio of its modes
DAMPERS_PATH = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Return the recording of a stepped sine over the three resonances, without noise."""
    return synthetic.stepped_sine(tmp_path_factory.mktemp("sweep") / "a.mcap", np.linspace(8.0, 60.0, 105))


@cache
def curves_with_dampers():
    """Return the frequency responses of the demo with moving dampers."""
    return analysis.frfs(DAMPERS_PATH)


def natural_modes_of(scene):
    """Return the natural frequencies in rad/s, and the mode shapes."""
    mass, _, stiffness = structure_matrices(scene.structure)
    return natural_modes(mass, stiffness)


def test_stepped_sine_gives_frequencies_and_damping(sweep):
    with daq.open(sweep) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves)
        omega, shapes = natural_modes_of(rec.scene)
    np.testing.assert_allclose(2 * np.pi * modes.frequency, omega, rtol=1e-6)
    np.testing.assert_allclose(modes.frequency, synthetic.NATURAL_FREQUENCIES, rtol=1e-5)
    np.testing.assert_allclose(modes.damping, DAMPING, rtol=1e-4)
    assert np.all(np.diag(analysis.mac(modes.shapes, shapes)) > 1 - 1e-9)
    np.testing.assert_allclose(modes.collinearity, 1.0, atol=1e-6)
    complex_shape = replace(modes, residue=np.array([[1.0], [0.5j]]))
    # abs(1 - 0.25)^2 / (1 + 0.25)^2
    np.testing.assert_allclose(complex_shape.collinearity, 0.36)


def test_table_reference_gives_resonances_with_spring(sweep):
    with daq.open(sweep) as rec:
        [curves] = analysis.frequency_responses(rec, reference="table")
        modes = analysis.identify(curves)
    np.testing.assert_allclose(2 * np.pi * modes.frequency, OMEGA_WITH_SPRING, rtol=1e-5)


def with_only(curve, limits):
    """Return the curve with only these systematic errors."""
    return replace(curve, uncertainty=curve.uncertainty.without(*curve.limits).with_limits(limits))


@pytest.mark.thorough
def test_mode_errors_agree_with_stated_uncertainty(tmp_path):
    normalized = []
    for seed in range(3):
        path = synthetic.stepped_sine(
            tmp_path / "a.mcap", np.linspace(8.0, 60.0, 105), noise=3e-6, seed=seed, periods=10
        )
        with daq.open(path) as rec:
            [curves] = analysis.frequency_responses(rec)
            # The synthetic data contain no aliased images of the drive.
            modes = analysis.identify([with_only(curve, {}) for curve in curves])
            omega, _ = natural_modes_of(rec.scene)
        normalized.append((modes.frequency - omega / (2 * np.pi)) / modes.frequency_std)
        normalized.append((modes.damping - DAMPING) / modes.damping_std)
        np.testing.assert_allclose(modes.frequency, omega / (2 * np.pi), rtol=2e-4)
        np.testing.assert_allclose(modes.damping, DAMPING, rtol=0.05)
    assert 0.3 < np.std(normalized) < 2.0


def test_few_points_in_peak_warn_of_extrapolated_damping(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 60))) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves)
    assert "extrapolated from the flanks" in " ".join(modes.warnings)
    assert ", extrapolated" in describe_modes(modes, frfs=curves)[2]


def test_too_few_points_are_rejected(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [10.0, 20.0, 30.0])) as rec:
        [curves] = analysis.frequency_responses(rec)
    with pytest.raises(RecordingError, match="3 frequencies are too few"):
        analysis.identify(curves)


def test_message_on_unlabeled_responses_names_them():
    frequency = np.linspace(5.0, 60.0, 5)
    with pytest.raises(RecordingError, match=r"^responses: 5 frequencies are too few"):
        analysis.identify([Response.curve(frequency, 1.0 / (frequency + 1j), "body1")])


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_has_no_mode(seed):
    random = np.random.default_rng(seed)
    frequency = np.linspace(5.0, 60.0, 200)
    value = random.standard_normal((2, 200)) + 1j * random.standard_normal((2, 200))
    with pytest.raises(RecordingError, match="no resonance"):
        analysis.identify(curves_of(frequency, value, np.full(200, 1.0)))


def curves_of(frequency, value, error):
    """Return responses of body 1, 2, ... from values (responses, frequencies) with a standard uncertainty."""
    ones = np.ones(frequency.size)
    return [
        Response.curve(frequency, row, f"body{number}", error=error, coherence=ones, degrees_of_freedom=38.0 * ones)
        for number, row in enumerate(value, 1)
    ]


def two_modes(natural, distance, zeta, lines, noise=0.0, seed=0):
    """Return the natural frequencies of two modes, Hz, and three responses.

    `natural`: lower natural frequency, Hz; `distance` of the frequencies relative to it; `noise` relative to the
    maximum.
    """
    random = np.random.default_rng(seed)
    shapes = random.uniform(0.2, 1.0, (3, 2)) * random.choice([-1.0, 1.0], (3, 2))
    frequency = np.linspace(0.7 * natural, 1.4 * natural, lines)
    s = 2j * np.pi * frequency
    omega = 2 * np.pi * natural * np.array([1.0, 1.0 + distance])
    modes = 1.0 / (s**2 + 2.0 * zeta * omega[:, None] * s + omega[:, None] ** 2)
    value = shapes @ modes
    error = noise * abs(value).max() * np.ones(lines)
    real_noise, imaginary_noise = random.standard_normal((2, *value.shape))
    return omega / (2 * np.pi), curves_of(frequency, value + error * (real_noise + 1j * imaginary_noise), error)


def one_mode(frequency, natural, zeta):
    """Return the response of a mode relative to its static response."""
    return 1.0 / (1.0 + 2j * zeta * frequency / natural - (frequency / natural) ** 2)


@pytest.mark.parametrize(
    ("delay", "error", "message"),
    [(0.05, 1e-5, "but body1 alone has modes: a channel is late"), (0.0, 1e-3, "body1: no model of few modes fits")],
)
def test_clear_peaks_without_modes_are_explained(delay, error, message):
    frequency = np.linspace(5.0, 60.0, 441)
    low, high = one_mode(frequency, 23.0, 0.006), one_mode(frequency, 48.0, 0.006)
    value = np.stack([low + 0.3 * high, (low - 0.5 * high) * np.exp(-2j * np.pi * frequency * delay)])
    if not delay:  # three modes closer than their half-power width
        close = [one_mode(frequency, natural, 0.0085) for natural in (35.6, 35.82, 36.02)]
        value = np.array([[1.0, -2.0, 1.0]]) @ np.stack(close)
    with pytest.raises(RecordingError, match=message):
        analysis.identify(curves_of(frequency, value, np.full(441, error)))


@pytest.mark.parametrize("zeta", [0.002, 0.01])
@pytest.mark.parametrize("seed", [1, 2])
def test_close_modes_without_noise_are_separated(zeta, seed):
    natural, frfs = two_modes(30.0 + seed, 2.0 * zeta, zeta, 250, seed=seed)
    modes = analysis.identify(frfs)
    np.testing.assert_allclose(modes.frequency, natural, rtol=1e-6)
    np.testing.assert_allclose(modes.damping, zeta, rtol=1e-4)


def test_close_noisy_modes_lie_within_uncertainty():
    zeta = 0.005
    natural, frfs = two_modes(30.0, 0.01, zeta, 250, noise=0.01, seed=3)
    modes = analysis.identify(frfs)
    assert modes.frequency.size == 2
    assert np.all(abs(modes.frequency - natural) < 3.0 * modes.frequency_std)
    assert np.all(abs(modes.damping - zeta) < 3.0 * modes.damping_std)
    assert np.all(modes.damping_std < 0.1 * zeta)


def test_stabilization_diagram_shows_poles_and_modes():
    _, frfs = two_modes(30.0, 0.2, 0.005, 250, noise=1e-3, seed=3)
    modes = analysis.identify(frfs)
    *kinds, first, second = modes.plot_stabilization(Figure().subplots()).lines
    assert sum(len(kind.get_xdata()) for kind in kinds) == len(modes.chart)
    np.testing.assert_allclose([line.get_xdata()[0] for line in (first, second)], modes.frequency)
    stable = next(kind for kind in kinds if kind.get_label() == "stable")
    # Each mode is a column of stable poles.
    distance = abs(stable.get_xdata()[:, None] - modes.frequency)
    assert np.all(np.sum(distance < 0.005 * modes.frequency, axis=0) > 10)


@pytest.mark.parametrize(
    ("natural", "zeta"),
    [((98.5, 101.5), (0.032, 0.016)), ((99.5, 100.5), (0.02, 0.012)), ((97.0, 103.0), (0.03, 0.02))],
)
def test_close_modes_of_different_responses_are_separated(natural, zeta):
    # A file without errors: each mode is in one response only, as in two directions of a machine.
    random, frequency = np.random.default_rng(0), np.arange(50.0, 150.0, 0.25)
    s, omega = 2j * np.pi * frequency[:, None], 2 * np.pi * np.array(natural)
    value = 1.0 / (s**2 + 2.0 * np.array(zeta) * omega * s + omega**2)
    value *= 1.0 + 2e-3 * (random.standard_normal(value.shape) + 1j * random.standard_normal(value.shape))
    modes = analysis.identify([Response.curve(frequency, row, name) for name, row in zip("xy", value.T, strict=True)])
    assert modes.frequency == pytest.approx(natural, abs=0.2)
    assert np.all(abs(modes.frequency - natural) < 3.0 * modes.frequency_std)
    assert np.all(abs(modes.damping - zeta) < 3.0 * modes.damping_std)


@pytest.mark.parametrize("has_model_error", [False, True])
def test_model_error_does_not_split_a_peak(has_model_error):
    _, frfs = two_modes(30.0, 0.012, 0.01, 250, noise=1e-5, seed=3)
    value = np.stack([frf.value for frf in frfs])
    # The poles are 0.6 half-power widths apart.
    curves = Curves(
        frfs[0].frequency, value, np.full(value.shape, 1e5 / abs(value).max()), has_model_error=has_model_error
    )
    model = fit(curves, 2 * np.pi * 30.0 * np.array([1.0, 1.012]) * (-0.01 + 1j))
    assert bool(computational_poles(curves, model).size) == has_model_error


def test_clock_error_limits_frequencies():
    natural, frfs = two_modes(30.0, 0.2, 0.005, 250, noise=1e-6, seed=3)
    clock = 50e-6  # relative error of the sample clock, at its limit
    modes = analysis.identify(
        [
            replace(frf, uncertainty=replace(frf.uncertainty, clock=clock), frequency=frf.frequency / (1.0 + clock))
            for frf in frfs
        ]
    )
    assert np.all(abs(modes.frequency - natural) < 1.96 * modes.frequency_std)
    assert modes.frequency_std == pytest.approx(clock * natural / 1.96, rel=0.2)


def test_modes_below_band_are_not_counted():
    frequency = np.linspace(42.0, 56.0, 80)
    s = 2j * np.pi * frequency
    omega, zeta = 2 * np.pi * np.array([[13.0], [35.0], [49.7]]), 0.005
    value = np.array([[1.0, 0.8, 0.5], [0.7, -0.9, 0.3]]) @ (1.0 / (s**2 + 2.0 * zeta * omega * s + omega**2))
    modes = analysis.identify(curves_of(frequency, value, np.zeros(80)))
    np.testing.assert_allclose(modes.frequency, [49.7], rtol=1e-5)
    np.testing.assert_allclose(modes.damping, zeta, rtol=1e-3)


@pytest.mark.parametrize(("ratio", "warned"), [(0.33, False), (0.5, True)])
def test_leakage_warns_of_increased_damping(ratio, warned):
    # A random test with Hann windows convolves the mode's response with the squared spectrum of the window.
    natural, zeta = 30.0, 0.01
    resolution = ratio * zeta * natural
    spacing = resolution / 1.5  # the noise bandwidth of a Hann window is 1.5 bins
    offset_bins = np.linspace(-30.0, 30.0, 6001)
    window = (np.sinc(offset_bins) + 0.5 * np.sinc(offset_bins - 1.0) + 0.5 * np.sinc(offset_bins + 1.0)) ** 2
    frequency = np.arange(24.0, 36.0, spacing)
    s = 2j * np.pi * (frequency[:, None] - spacing * offset_bins)
    pole = 2 * np.pi * natural * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    value = (1.0 / ((s - pole) * (s - pole.conjugate()))) @ (window / window.sum())
    zeros = np.zeros(frequency.size)
    frf = Response.curve(
        frequency, value, "body1", error=zeros + 1e-3 * abs(value).max(), degrees_of_freedom=zeros + 38.0,
        resolution=resolution,
    )  # fmt: skip
    modes = analysis.identify([frf], count=1)
    assert any("widens the peaks" in warning for warning in modes.warnings) == warned
    assert (modes.damping[0] / zeta - 1.0 > 0.02) == warned
    assert modes.damping[0] / zeta - 1.0 == pytest.approx(LEAKAGE_FACTOR * ratio**2, rel=0.25)


@pytest.mark.parametrize(
    ("seed", "natural", "zeta"), [(102, 27.40, 0.01420), (113, 26.06, 0.00811), (115, 35.54, 0.01445)]
)
def test_interval_contains_widening_and_random_error(seed, natural, zeta):
    # Averages of blocks with Hann windows, from a random test of 5 minutes.
    rate, block = 256, 256 * 8
    force = np.random.default_rng(seed).standard_normal(rate * 360)
    s, omega = 2j * np.pi * np.fft.rfftfreq(force.size, 1 / rate), 2 * np.pi * natural
    motion = np.fft.irfft(np.fft.rfft(force) * s**2 / (s**2 + 2 * zeta * omega * s + omega**2))
    settled = slice(rate * 40, None)
    frequency, cross = scipy.signal.csd(force[settled], motion[settled], rate, "hann", block)
    _, power = scipy.signal.welch(force[settled], rate, "hann", block)
    band = (frequency > 5.0) & (frequency < 100.0)
    curve = Response.curve(
        frequency[band], (cross / power)[band], "tip", motion="acceleration", resolution=1.5 * rate / block
    )
    modes = analysis.identify([curve])
    assert modes.damping == pytest.approx([zeta], abs=2.0 * float(modes.damping_std[0]))


@pytest.mark.parametrize(("hum", "named"), [(150.0, True), (130.0, False)])
def test_mains_hum_is_named(hum: float, named: bool) -> None:
    frequency = np.arange(1.0, 300.0, 0.5)
    s, omega = 2j * np.pi * frequency, 2 * np.pi * 90.0
    value = s**2 / (s**2 + 0.04 * omega * s + omega**2)
    value[np.argmin(abs(frequency - hum))] += 20.0
    random = np.random.default_rng(3)
    value += 0.01 * (random.standard_normal(value.size) + 1j * random.standard_normal(value.size))

    modes = analysis.identify([Response.curve(frequency, value, "a1", motion="acceleration", resolution=0.75)])

    assert modes.frequency == pytest.approx([90.0], abs=0.1)
    # The spike of a single line may be a mode or not, because half of the lines do not contain it.
    [uncertain] = modes.uncertain
    assert uncertain.frequency == pytest.approx(hum, abs=1.0) and "lines" in uncertain.reason
    assert any(f"{hum:g} Hz (3 x 50 Hz): probably mains hum" in warning for warning in modes.warnings) is named


def test_peak_without_width_is_not_the_highest() -> None:
    frequency = np.arange(1.0, 300.0, 0.5)
    s, omega = 2j * np.pi * frequency, 2 * np.pi * 90.0
    value = s**2 / (s**2 + 0.04 * omega * s + omega**2)
    # The pole of this peak lies between two lines, on the imaginary axis.
    value += 5.0 / (150.25 - frequency)
    curve = Response.curve(frequency, value, "a1", motion="acceleration", resolution=0.75)

    assert analysis.identify([curve], count=1).frequency == pytest.approx([90.0], abs=0.1)


@pytest.mark.parametrize("windowed", [False, True])
def test_narrow_peaks_in_files_have_large_uncertainty(windowed, tmp_path):
    # Peaks narrower than the line spacing: without a window, or from a random test with Hann windows.
    random, spacing = np.random.default_rng(5), 0.25
    natural, half_widths = np.array([31.4, 71.23]), np.array([0.04, 0.2]) * spacing
    frequency = spacing * np.arange(60, 400)
    offset_bins = np.linspace(-20.0, 20.0, 401) if windowed else np.zeros(1)
    window = (np.sinc(offset_bins) + 0.5 * np.sinc(offset_bins - 1.0) + 0.5 * np.sinc(offset_bins + 1.0)) ** 2
    s = 2j * np.pi * (frequency[:, None] - spacing * offset_bins)
    pole = 2 * np.pi * (-half_widths + 1j * natural)
    value = sum(1.0 / ((s - p) * (s - p.conjugate())) for p in pole) @ (window / window.sum())
    value += 1e-2 * np.median(abs(value)) * (random.standard_normal((2, 340)).T @ [1.0, 1j])
    table = np.column_stack([frequency, value.real, value.imag])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="f [Hz],a re [m/N],a im [m/N]", comments="")
    modes = analysis.identify(analysis.read_frfs(tmp_path / "a.csv"))
    assert modes.frequency.size == 2
    assert np.all(abs(modes.frequency - natural) < 2.0 * modes.frequency_std)
    assert np.all(modes.frequency_std < spacing)
    assert np.all(abs(modes.damping - half_widths / natural) < 2.0 * modes.damping_std)
    assert np.all(modes.damping + 2.0 * modes.damping_std < 2.0 * spacing / natural)
    assert modes.damping_text(0).startswith("below")
    assert replace(modes, damping_std=modes.damping + 1.0).damping_text(0) == "not determined"
    assert sum("narrower than the resolution" in warning for warning in modes.warnings) == 1


@pytest.mark.thorough
def test_jump_is_reported_as_nonlinear(sweep):
    [curves] = analysis.frequency_responses(sweep)
    # A jump between resonances, which dampers cause when they lift off.
    jump = np.where(curves[0].frequency > 24.3, 0.8 + 0.3j, 1.0)
    modes = analysis.identify([replace(curve, value=curve.value * jump) for curve in curves])
    assert np.all(modes.damping > 1e-4) and np.all(modes.damping_std < 0.5 * modes.damping)
    assert modes.model_error > 0.01
    assert any("The modes do not explain the response" in warning for warning in modes.warnings)


def test_modes_with_flying_dampers_are_linear_equivalents():
    frfs = curves_with_dampers()
    modes = analysis.identify(frfs)
    largest = max((abs(frf.value) for frf in frfs), key=lambda magnitude: magnitude.max())
    assert len(modes.frequency) == 3
    # The peak of the first mode is the highest.
    highest_peak = frfs[0].frequency[largest.argmax()]
    assert abs(modes.frequency[0] / highest_peak - 1) < modes.damping[0]
    assert "The modes do not explain the response" in " ".join(modes.warnings) and modes.model_error > 0.01


@pytest.mark.parametrize("width_ratio", [1e-6, 0.1, 5.0])
def test_pole_errors_are_independent_of_initial_damping(width_ratio):
    natural, frfs = two_modes(30.0, 0.2, 0.01, 400, noise=1e-3, seed=4)
    value, frequency = np.stack([frf.value for frf in frfs]), frfs[0].frequency
    curves = Curves(frequency, value, np.full(value.shape, 1e3 / abs(value).max()))
    decay_rate = 2 * np.pi * 0.01 * natural
    near, far = (fit(curves, -ratio * decay_rate + 2j * np.pi * natural) for ratio in (1.0, width_ratio))
    np.testing.assert_allclose(far.poles, near.poles, rtol=1e-6)
    np.testing.assert_allclose(pole_errors(curves, far), pole_errors(curves, near), rtol=1e-3)


def test_lines_of_infinite_error_do_not_hide_nonlinearity():
    frfs = curves_with_dampers()
    limit = np.where(abs(frfs[0].frequency - 24.0) < 4.0, np.inf, 0.0)
    zero_in_part = replace(frfs[1], value=np.where(limit > 0.0, 0.0, frfs[1].value))
    limited = [frf.with_limits({UNSETTLED: limit}) for frf in (frfs[0], zero_in_part)]
    modes = analysis.identify([*limited, frfs[2]])
    assert len(modes.frequency) == 3
    assert modes.model_error > 0.01
    assert np.isfinite(modes.frequency_std).all() and np.isfinite(modes.damping_std).all()


def test_spring_force_tolerance_is_in_frequency_uncertainty():
    # If the sensors of a spring force differ, the force contains a part of the motion, like a change of stiffness.
    natural, frfs = two_modes(30.0, 0.2, 0.01, 400, noise=1e-4, seed=4)
    relative_error = 0.2 * frfs[0].value / abs(frfs[0].value).max()
    values = [frf.value / (1.0 + relative_error) for frf in frfs]
    modes = analysis.identify(
        [
            with_only(replace(frf, value=value), {SENSITIVITY: abs(relative_error * value)})
            for frf, value in zip(frfs, values, strict=True)
        ]
    )
    assert np.all(abs(modes.frequency - natural) < 2.0 * modes.frequency_std)
    assert np.all(modes.frequency_std < 3e-3 * natural)
    assert np.max(abs(modes.frequency / natural - 1.0)) > 1e-4


PEAK_IN_GAP = 12.85  # Hz
DAMPING_IN_GAP = 0.0117  # half-power width of 0.3 Hz


def peak_in_gap(lines):
    """Return curves with a peak at 12.85 Hz that is measured only at the given lines, Hz."""
    frequency = np.concatenate([np.linspace(8.4, 10.5, 140), lines, np.linspace(14.8, 15.7, 40)])
    s = 2j * np.pi * frequency
    omega = 2 * np.pi * np.array([[PEAK_IN_GAP], [41.1], [56.9]])
    value = np.array([[0.6, -0.4, 0.3], [0.9, 0.2, -0.7]]) @ (
        1.0 / (s**2 + 2.0 * DAMPING_IN_GAP * omega * s + omega**2)
    )
    return [
        replace(
            frf, uncertainty=UncertaintyBudget.of(relative_error * abs(frf.value), frf.degrees_of_freedom, shared=15.0)
        )
        for frf, relative_error in zip(curves_of(frequency, value, 1.0), (1e-3, 1e-2), strict=True)
    ]


def test_damping_from_a_single_line_lies_within_error():
    # The curvature due to distant modes is below the noise of each line, but larger than the effect of damping.
    modes = analysis.identify(peak_in_gap([12.75]))
    assert modes.damping == pytest.approx([DAMPING_IN_GAP], abs=2.0 * modes.damping_std[0])
    assert modes.damping_std[0] < 0.2 * DAMPING_IN_GAP


def test_peak_without_lines_is_no_mode():
    # The flanks would determine a single pole with small errors, although there may be two.
    with pytest.raises(RecordingError, match=r"12\.8.* Hz\) lie where points of the curves were omitted"):
        analysis.identify(peak_in_gap([]))


def test_sensor_tolerance_is_in_shape_uncertainty(sweep):
    [curves] = analysis.frequency_responses(sweep)
    inaccurate = with_only(curves[1], {SENSITIVITY: 0.2 * abs(curves[1].value)})
    modes = analysis.identify([curves[0], inaccurate, curves[2]])
    relative_error = modes.shape_std / abs(modes.shapes)
    largest = abs(modes.shapes).argmax(axis=0)
    for mode in range(3):
        for response in range(3):
            # Shapes are relative to their largest component, so that its error is in all other components.
            is_uncertain = response != largest[mode] and 1 in (response, largest[mode])
            error = relative_error[response, mode]
            assert (0.09 < error < 0.15) if is_uncertain else error < 0.01


def test_force_tolerance_does_not_affect_shapes(sweep) -> None:
    [curves] = analysis.frequency_responses(sweep)
    exact = analysis.identify(curves)
    modes = analysis.identify([with_sensors(curve, force=0.15) for curve in curves])
    np.testing.assert_allclose(modes.shape_std, exact.shape_std, atol=1e-3)


def test_shapes_contain_tolerances_of_two_sensors(sweep) -> None:
    [curves] = analysis.frequency_responses(sweep)
    modes = analysis.identify([with_sensors(curve, force=0.11, **{curve.response: 0.11}) for curve in curves])
    # A component is the ratio of two readings: two independent limits of error of 11 %, without that of the force.
    np.testing.assert_allclose(
        modes.shape_std, abs(modes.shapes) * 0.11 * np.sqrt(2.0 / 3.0) * (modes.shape_std > 0.0), rtol=0.05
    )


def with_sensors(curve: Response, **tolerances: float) -> Response:
    """Return a curve with the tolerances of sensors, by name."""
    limits = {SENSITIVITY: sum(tolerances.values()) * abs(curve.value)}
    sources = {SENSITIVITY: {name: tolerance * curve.value for name, tolerance in tolerances.items()}}
    return replace(curve, uncertainty=UncertaintyBudget.of(curve.error, curve.degrees_of_freedom, limits, sources))


@pytest.mark.parametrize(("relative_limit", "identified"), [(1.5, False), (0.5, True)])
def test_peak_within_systematic_error_is_rejected(relative_limit, identified):
    frequency = np.linspace(10.0, 60.0, 400)

    def peak(natural, zeta, height):
        return height * 2 * zeta * natural**2 / (natural**2 - frequency**2 + 2j * zeta * natural * frequency)

    # Relative to the height of the second peak, 0.02, the systematic error is large at the peak and small on its
    # flanks.
    limit = np.where(abs(frequency - 40.0) < 0.5, relative_limit * 0.02, 2e-4)
    [curve] = curves_of(frequency, (peak(20.0, 0.012, 1.0) + peak(40.0, 0.05, 0.02))[None], np.full(400, 1e-5))
    modes = analysis.identify([with_only(curve, {UNSETTLED: limit})])
    np.testing.assert_allclose(modes.frequency, [20.0, 40.0] if identified else [20.0], rtol=1e-4)
    assert any("Rejected the stable poles" in text for text in modes.warnings) != identified


def test_list_of_several_tests_is_rejected(sweep):
    with daq.open(sweep) as rec:
        tests = analysis.frequency_responses(rec)
    with pytest.raises(SceneError, match="Give one element of the list"):
        analysis.identify(tests)


@pytest.mark.parametrize(
    ("noise", "remedies"), [(1e-5, []), (1.0, ["Record longer after each impact (test.interval: 31 s or more)."])]
)
def test_remedy_of_few_lines_suits_hits(tmp_path, noise, remedies):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", interval=4.0, hits=2, noise=noise)) as rec:
        [curves] = analysis.frequency_responses(rec)
        warnings = analysis.identify(curves.band(5.0, 60.0)).warnings
    assert [text.partition("flanks. ")[2] for text in warnings if "flanks" in text] == remedies


def test_rejected_poles_are_named_without_modes() -> None:
    random, frequency = np.random.default_rng(0), np.arange(30.0, 400.0, 0.5)
    value = 1.0 / (1.0 - (frequency / 190.0) ** 2 + 0.008j * frequency / 190.0)
    noise = random.standard_normal(frequency.size) + 1j * random.standard_normal(frequency.size)
    with pytest.raises(RecordingError, match=r"Uncertain modes: \(189\.80 ± 0\.53\) Hz \(frequency is uncertain\)"):
        analysis.identify([Response.curve(frequency, value + 0.4 * abs(value) * noise, "a")])


def test_mode_next_to_flank_of_another_is_identified() -> None:
    # The peak of another mode is 1 Hz below these lines: without its pole, the mode reduces the misfit too little.
    curves = [curve.to("displacement").band(466.6, 613.9) for curve in draw_curves(21, 38).curves]
    natural = abs(fit_modes(curves).model.poles) / (2 * np.pi)
    assert abs(natural - 539.85).min() < 0.5
