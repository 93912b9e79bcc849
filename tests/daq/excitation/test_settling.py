"""Detection of steady state: transients that decay, beat, or are below the noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from daq.excitation.settling import Settling

TOLERANCE = 1e-3
LOOK = 0.1


def judged(amplitude: Callable[[int], complex | np.ndarray], max_looks: int = 2000) -> tuple[int, Settling]:
    detector = Settling(TOLERANCE)
    for look in range(max_looks):
        detector.add(np.atleast_1d(np.asarray(amplitude(look), dtype=complex)))
        if detector.settled:
            return look, detector
    return max_looks, detector


@pytest.mark.parametrize("constant", [0.05, 0.5, 2.44, 12.0])
@pytest.mark.parametrize("beat", [0.0, 0.3, 2.2, 7.1])
@pytest.mark.parametrize("share", [0.01, 1.0, 20.0])
def test_settled_transient_is_below_tolerance(constant: float, beat: float, share: float) -> None:
    pole = -1.0 / constant + 2j * np.pi * beat

    def transient(look: int) -> complex:
        return complex(share * np.exp(pole * LOOK * look))

    look, _ = judged(lambda look: 1.0 + transient(look))
    assert abs(transient(look)) < 1.2 * TOLERANCE
    # The wait is not much longer than necessary.
    needed = constant * np.log(max(share / TOLERANCE, 1.0)) / LOOK
    assert look <= needed + 0.3 * constant / LOOK + 12


def test_settled_beat_is_below_tolerance() -> None:
    poles = np.array([-1 / 2.44 + 2j * np.pi * 1.3, -1 / 0.9 - 2j * np.pi * 3.1])

    def transient(look: int) -> complex:
        return complex(np.sum(0.3 * np.exp(poles * LOOK * look)))

    look, _ = judged(lambda look: 1.0 + transient(look))
    assert abs(transient(look)) < 1.2 * TOLERANCE
    assert look < 2.44 * np.log(300) / LOOK + 15


def test_noise_settles_after_transient() -> None:
    random = np.random.default_rng(1)
    noise = 0.01 * (random.standard_normal(400) + 1j * random.standard_normal(400))
    look, detector = judged(lambda look: 1.0 + 0.5 * 0.6**look + noise[look])
    assert 20 < look < 80
    assert abs(detector.expected()[0] - 1.0) < 0.02
    assert 0.001 < detector.standard_error()[0] < 0.02


def test_drift_is_not_steady() -> None:
    look, _ = judged(lambda look: 1.0 + 0.002 * look, max_looks=300)
    assert look == 300


def test_slowest_quantity_decides() -> None:
    look, _ = judged(lambda look: np.array([1.0, 1e-6 * (1 + 0.95**look)]))
    assert 0.95**look < 1.2 * TOLERANCE


def test_end_of_long_transient_is_predicted() -> None:
    detector = Settling(TOLERANCE)
    for look in range(6):
        detector.add(np.array([2.0 - 1.9 * 0.96**look + 0j]))
    assert not detector.settled
    assert detector.expected()[0] == pytest.approx(2.0, rel=1e-9)
    assert detector.forecast_change()[0] < 1e-9


def test_restart_forgets_earlier_observations() -> None:
    detector = Settling(TOLERANCE)
    for _ in range(10):
        detector.add(np.array([1.0 + 0j]))
    assert detector.settled
    detector.restart()
    assert not detector.settled and detector.count == 0
