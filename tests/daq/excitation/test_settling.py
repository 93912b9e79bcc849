"""`Settling` detects the steady state of a tone's complex amplitudes: transients that decay, beat, or are noise.

The amplitude is observed at a constant interval; its steady value is 1.
"""

import numpy as np
import pytest

from daq.core.excitation.tones.settling import Settling

TOLERANCE = 1e-3
INTERVAL_S = 0.1  # Between observations.


def observe_until_settled(amplitude, max_observations=2000):
    """Return the number of the observation at which the steady state is detected, and the detector."""
    detector = Settling(TOLERANCE)
    for observation in range(max_observations):
        detector.add(np.atleast_1d(np.asarray(amplitude(observation), dtype=complex)))
        if detector.settled:
            return observation, detector
    return max_observations, detector


@pytest.mark.parametrize("time_constant", [0.05, 0.5, 2.44, 12.0])
@pytest.mark.parametrize("beat_frequency", [0.0, 0.3, 2.2, 7.1])
@pytest.mark.parametrize("initial", [0.01, 1.0, 20.0])
def test_settled_transient_is_below_tolerance(time_constant: float, beat_frequency: float, initial: float) -> None:
    pole = -1.0 / time_constant + 2j * np.pi * beat_frequency

    def transient(observation: int) -> complex:
        return complex(initial * np.exp(pole * INTERVAL_S * observation))

    observation, _ = observe_until_settled(lambda observation: 1.0 + transient(observation))
    assert abs(transient(observation)) < 1.2 * TOLERANCE
    # The wait is longer than necessary by at most 0.3 time constants and 12 observations.
    needed_observations = time_constant * np.log(max(initial / TOLERANCE, 1.0)) / INTERVAL_S
    assert observation <= needed_observations + 0.3 * time_constant / INTERVAL_S + 12


def test_settled_beat_is_below_tolerance() -> None:
    poles = np.array([-1 / 2.44 + 2j * np.pi * 1.3, -1 / 0.9 - 2j * np.pi * 3.1])

    def transient(observation: int) -> complex:
        return complex(np.sum(0.3 * np.exp(poles * INTERVAL_S * observation)))

    observation, _ = observe_until_settled(lambda observation: 1.0 + transient(observation))
    assert abs(transient(observation)) < 1.2 * TOLERANCE
    # The slower transient decays from 0.3 to the tolerance.
    assert observation < 2.44 * np.log(0.3 / TOLERANCE) / INTERVAL_S + 15


def test_noise_settles_after_transient() -> None:
    random = np.random.default_rng(1)
    noise = 0.01 * (random.standard_normal(400) + 1j * random.standard_normal(400))
    observation, detector = observe_until_settled(lambda observation: 1.0 + 0.5 * 0.6**observation + noise[observation])
    # The scatter of 24 observations is compared; the transient is below the noise after 8.
    assert 20 < observation < 80
    assert abs(detector.predicted_final() - 1.0) < 0.02
    # Noise of 0.01 in each of two components, averaged over 12 observations: 0.004.
    assert 0.001 < detector.standard_error() < 0.02


def test_drift_is_not_steady() -> None:
    observation, _ = observe_until_settled(lambda observation: 1.0 + 0.002 * observation, max_observations=300)
    assert observation == 300


def test_slowest_amplitude_determines_steady_state() -> None:
    observation, _ = observe_until_settled(lambda observation: np.array([1.0, 1e-6 * (1 + 0.95**observation)]))
    assert 0.95**observation < 1.2 * TOLERANCE


def test_end_of_long_transient_is_predicted() -> None:
    detector = Settling(TOLERANCE)
    for observation in range(6):
        detector.add(np.array([2.0 - 1.9 * 0.96**observation + 0j]))
    assert not detector.settled
    assert detector.predicted_final() == pytest.approx(2.0, rel=1e-9)
    assert detector.prediction_change() < 1e-9


def test_restart_discards_earlier_observations() -> None:
    detector = Settling(TOLERANCE)
    for _ in range(10):
        detector.add(np.array([1.0 + 0j]))
    assert detector.settled
    detector.restart()
    assert not detector.settled and detector.count == 0
