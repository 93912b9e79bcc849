"""Modal identification of many responses, and of long tests: bounded memory and the same modes."""

import numpy as np
import pytest

import analysis
from analysis.core.modal import pole_errors
from analysis.core.modal_models import pole_residue
from analysis.core.modal_models.lscf import stabilization_diagram
from analysis.core.responses.errors import random_errors
from analysis.core.responses.errors.random_errors import LocalErrors, MeanErrors, SharedErrors
from rig.core.base.errors import RunError
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import UncertaintyBudget
from tests.peak_memory import peak_memory


def many_curves(count):
    """Return receptances of two modes at a number of points, with noise."""
    random, frequency = np.random.default_rng(3), np.linspace(5.0, 60.0, 400)
    s = 2j * np.pi * frequency
    value = np.zeros((count, frequency.size), dtype=complex)
    for natural in (15.0, 40.0):
        pole = 2 * np.pi * natural * (-0.01 + 1j)
        residue = random.standard_normal(count)[:, None] * -1j
        value += residue / (s - pole) + residue.conj() / (s - pole.conjugate())
    error = np.full(frequency.size, 1e-4 * abs(value).max())
    value += error * (random.standard_normal(value.shape) + 1j * random.standard_normal(value.shape))
    return stack(
        [
            Response.curve(frequency, row, f"p{k}", error=error, degrees_of_freedom=np.full(frequency.size, 100.0))
            for k, row in enumerate(value)
        ]
    )


def test_blocks_of_responses_give_the_same_modes(monkeypatch):
    curves = many_curves(12)
    whole = analysis.identify(curves)
    monkeypatch.setattr(pole_residue, "_MAX_ELEMENTS", 1)
    by_response = analysis.identify(curves)
    np.testing.assert_allclose(by_response.frequency, whole.frequency, rtol=1e-9)
    np.testing.assert_allclose(by_response.damping, whole.damping, rtol=1e-6)
    np.testing.assert_allclose(by_response.damping_std, whole.damping_std, rtol=1e-6)


POLES = 2 * np.pi * np.array([15.0, 40.0]) * (-0.01 + 1j)


def unweighted(count):
    """Return `many_curves` as input of a modal fit, all lines with equal weight."""
    curves = many_curves(count)
    return pole_residue.Curves(curves.frequency, curves.value[:, :, 0].T, np.ones((count, curves.frequency.size)))


def diagram_memory(count):
    curves = unweighted(count)
    return peak_memory(stabilization_diagram, curves.frequency, curves.value, curves.weight)[0]


def uncertainty_memory(count):
    curves = unweighted(count)
    return peak_memory(pole_errors.pole_errors, curves, pole_residue.fit(curves, POLES))[0]


def candidate_memory(count):
    added = 2 * np.pi * np.linspace(10.0, 50.0, 40) * (-0.01 + 1j)
    return peak_memory(pole_residue.misfits_with, unweighted(count), POLES, added)[0]


@pytest.mark.parametrize(
    ("memory", "count", "more"), [(diagram_memory, 16, 64), (uncertainty_memory, 64, 128), (candidate_memory, 32, 64)]
)
def test_memory_does_not_grow_with_responses(monkeypatch, memory, count, more):
    monkeypatch.setattr(pole_residue, "_MAX_ELEMENTS", 1 << 18)
    assert memory(more) < 1.3 * memory(count)


def gaussian(*shape):
    random = np.random.default_rng(5)
    return random.standard_normal(shape) + 1j * random.standard_normal(shape)


def covariance_of_lines(spacing):
    """Return the covariance of local fits to lines with a number of bins from line to line."""
    lines, elements, width = 50, 4, 25
    weights, residual = gaussian(lines, elements, 1, width), gaussian(lines, elements, 1, width)
    fitted_response = gaussian(lines, elements, width)
    first, *others = [
        SharedErrors.of(
            LocalErrors(
                weights[:, k], spacing * np.arange(lines), residual[:, k], fitted_response[:, k], np.ones(lines),
                10.0, 1.0, True, np.zeros((lines, 0)),
            )
        )
        for k in range(elements)
    ]  # fmt: skip
    return first.joined(others).covariance(np.ones((lines, elements)), 1.0)


def test_covariance_of_long_test_needs_little_memory(monkeypatch):
    monkeypatch.setattr(random_errors, "_MAX_ELEMENTS", 1 << 14)
    peaks = [peak_memory(covariance_of_lines(spacing).of_sums, gaussian(50, 4, 3))[0] for spacing in (100, 10_000)]
    assert peaks[1] < 1.5 * peaks[0]


def test_covariance_of_sums_does_not_depend_on_blocks(monkeypatch):
    covariance = covariance_of_lines(10)
    whole = covariance.of_sums(gaussian(50, 4, 3))
    monkeypatch.setattr(random_errors, "_MAX_ELEMENTS", 1)
    np.testing.assert_allclose(covariance.of_sums(gaussian(50, 4, 3)), whole, rtol=1e-12)


def test_selected_lines_share_the_array_of_their_test():
    test = gaussian(4, 50, 200)
    elements = [SharedErrors.of(MeanErrors(test, gaussian(200, 4))) for _ in range(10)]
    peak, _ = peak_memory(lambda: [each.at(np.arange(0, 200, 2)) for each in elements])
    assert peak < test.nbytes / 2


def test_covariance_of_too_many_responses_is_refused():
    with pytest.raises(RunError, match="covariance of 255 responses at 1640 frequencies would need"):
        UncertaintyBudget(()).covariance((1640, 255, 1))
