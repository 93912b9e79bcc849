"""A reversed force is detected from the driving-point response, which would supply energy; delay and noise are not."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.core.responses.checks.curve_checks import find_jumps, reversed_force
from rig.core.results.response import Response

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


def test_other_responses_may_have_any_phase() -> None:
    curve = measured(2)
    assert not reversed_force([curve, replace(curve, value=-curve.value)])


def test_uncertain_points_are_ignored() -> None:
    curve = measured(1, noise=0.5)
    assert not reversed_force([replace(curve, value=-curve.value)])


@pytest.mark.parametrize(("noise", "jumps"), [(1e-3, [(11.5, "jump down")]), (0.32, [])])
def test_step_within_noise_is_not_a_jump(noise: float, jumps: list[tuple[float, str]]) -> None:
    frequency = np.arange(10.0, 14.0)
    value = np.array([170e-6, 167e-6, 28e-6, 28e-6], dtype=complex)
    error = np.array([1e-8, 1e-8, noise * 28e-6, 1e-8])
    curve = Response.curve(frequency, value, "body1", error=error, degrees_of_freedom=np.full(4, 130.0))
    assert find_jumps(curve) == jumps
