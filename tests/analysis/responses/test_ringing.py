"""The bound of the transient that remains from the previous tone, against a closed form and a recording."""

from pathlib import Path

import numpy as np

import analysis
import daq
import rig
from analysis.core.responses.errors.ringing import poles_near_lines, ringing
from rig.core.base.arrays import Array, ComplexArray
from rig.core.system.structural_model import receptance

POLE = -0.9 + 2j * np.pi * 19.0  # 1/s, of a mode at 19 Hz.


def bound_of(value: ComplexArray, frequency: Array, wait_s: Array, window_s: Array, error: Array) -> Array:
    """Return the bound of the error due to ringing at each line."""
    return ringing(value, frequency, poles_near_lines(value, frequency, error), wait_s, window_s)


def test_residual_transients_stay_within_bound() -> None:
    frequency = np.linspace(18.55, 19.45, 25)
    omega, wait_s, window_s = 2 * np.pi * frequency, 7.0, 1.1
    steady = 1.0 / (1j * omega - POLE)
    change = np.diff(steady, prepend=steady[:1])
    rate = POLE - 1j * omega
    transient = -change * np.exp(rate * wait_s) * np.expm1(rate * window_s) / (rate * window_s)
    bound = bound_of(steady + transient, frequency, np.full(25, wait_s), np.full(25, window_s), np.zeros(25))
    assert (bound[1:] >= abs(transient[1:])).all()
    # The transition to the next tone ends within the first half of a window.
    assert (bound[1:] <= 1.8 * abs(transient[1:])).all()


def test_transients_of_close_resonances_are_bounded() -> None:
    frequency = np.linspace(36.1, 41.5, 40)
    omega, wait_s, window_s = 2 * np.pi * frequency, 6.0, 0.52
    poles = np.array([[-1.2 + 2j * np.pi * 38.44], [-1.3 + 2j * np.pi * 39.0]])
    steady = np.array([[1.0], [-0.6]]) / (1j * omega - poles)
    change = np.diff(steady, axis=1, prepend=steady[:, :1])
    rate = poles - 1j * omega
    transient = np.sum(-change * np.exp(rate * wait_s) * np.expm1(rate * window_s) / (rate * window_s), axis=0)
    random = np.random.default_rng(1)
    error = np.full(40, 1e-5 * abs(steady).max())
    noise = error * (random.standard_normal(40) + 1j * random.standard_normal(40))

    measured = steady.sum(axis=0) + transient + noise
    bound = bound_of(measured, frequency, np.full(40, wait_s), np.full(40, window_s), error)

    significant = abs(transient) > 3.0 * error
    assert significant.sum() > 5
    assert (bound >= 0.9 * abs(transient))[significant].all()


def test_points_far_from_resonances_have_no_transient() -> None:
    sparse = np.array([10.0, 15.0, 19.0, 24.0, 30.0])
    assert not bound_of(1.0 / (2j * np.pi * sparse - POLE), sparse, np.ones(5), np.ones(5), np.zeros(5)).any()
    dense = np.linspace(18.5, 19.5, 25)
    assert not bound_of(2j * np.pi * dense - POLE, dense, np.ones(25), np.ones(25), np.zeros(25)).any()
    assert bound_of(np.ones(1) + 0j, *[np.ones(1)] * 4).tolist() == [0.0]


def measured_and_normalized_error(scene: rig.Scene, folder: Path, row: int) -> tuple[rig.Response, Array]:
    """Record a scene; return the response of channel a, and its errors relative to their bounds; `row`: of its body."""
    with daq.open(daq.record(scene, folder / "a.mcap")) as recording:
        frf = analysis.frfs(recording)["a"]
    return frf, abs(frf.value - receptance(scene, frf.frequency)[row]) / frf.bound()


def test_uncertainty_covers_residual_transients_with_noise(tmp_path) -> None:
    scene = rig.loads(
        """
        structure: {masses: [1.9 kg, 1.4 kg], springs: [60 kN/m, 40 kN/m], damping: {modal: 0.7 %}}
        shaker: {kind: force, body: 1}
        test: {kind: stepped_sine, from: 17.9 Hz, to: 18.8 Hz, points: 25, force: 4 N}
        channels:
          - {name: force, at: shaker, hammer: {sensitivity: 20 mV/N}}
          - {name: a, at: body 2, accelerometer: {sensitivity: 100 mV/g, noise: 30 ug/sqrt(Hz)}}
        converter: {rate: 5120 Hz, bits: 24, range: 5 V}
        recording: {display: false}
        seed: 1
        """
    )
    _, normalized = measured_and_normalized_error(scene, tmp_path, row=1)
    # 95 % intervals of 25 points.
    assert (normalized > 1.0).sum() <= 3
    assert normalized.max() < 1.5


def test_uncertainty_covers_transients_of_feedback(tmp_path) -> None:
    scene = rig.loads(
        """
        structure: {masses: [2 kg], springs: [31.58 kN/m], damping: {modal: 0.8 %}}
        shaker: {kind: force, body: 1}
        test: {kind: constant_response, at: body 1, from: 19.52 Hz, to: 20.48 Hz, points: 25, acceleration: 10 m/s^2}
        channels:
          - {name: force, at: shaker, hammer: {sensitivity: 100 mV/N}}
          - {name: a, at: body 1, accelerometer: {sensitivity: 100 mV/g, noise: 60 ug/sqrt(Hz)}}
        converter: {rate: 5120 Hz, bits: 24, range: 10 V}
        recording: {display: false}
        seed: 1
        """
    )
    frf, normalized = measured_and_normalized_error(scene, tmp_path, row=0)
    assert (normalized > 1.0).sum() <= 3
    assert normalized.max() < 1.5
    # Slower transients are hidden by noise, but smaller than the accepted ones.
    assert np.median(frf.bound() / abs(frf.value)) < scene.test.settle.tolerance
