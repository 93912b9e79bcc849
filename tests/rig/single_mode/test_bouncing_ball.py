"""The closed form of the completely inelastic ball (`tests.rig.bouncing_ball`) obeys its definition."""

from itertools import pairwise

import numpy as np
import pytest

from tests.rig.bouncing_ball import FULL_PERIOD_ACCELERATION_G, fly, sticking_cycle, take_off_phase


@pytest.mark.parametrize("acceleration", [1.01, 1.5, 2.2, 3.2, 3.6, 5.0, 9.0])
def test_flight_ends_at_the_first_contact(acceleration: float) -> None:
    start = take_off_phase(acceleration)

    flight = fly(acceleration, start)

    # Positions in units of g/w^2, times in 1/w: free fall is -t^2 / 2, and take-off is at -1 g.
    t = np.linspace(0, 1, 4001)[1:-1] * (flight.end - flight.start)
    body = acceleration * np.sin(start + t)
    ball = acceleration * (np.sin(start) + np.cos(start) * t) - t**2 / 2
    assert np.sin(start) * acceleration == pytest.approx(1, abs=1e-12)
    # The first gaps are within rounding error.
    assert (ball > body)[20:].all()
    assert (ball > body - 1e-12).all()
    duration = flight.end - start
    final_gap = acceleration * (np.sin(start) - np.sin(flight.end) + np.cos(start) * duration) - duration**2 / 2
    assert abs(final_gap) < 1e-12


def test_full_period_flight_takes_one_period() -> None:
    flight = fly(FULL_PERIOD_ACCELERATION_G, take_off_phase(FULL_PERIOD_ACCELERATION_G))

    assert flight.end - flight.start == pytest.approx(2 * np.pi, abs=1e-9)


def test_ball_sticks_every_period_at_low_acceleration() -> None:
    for acceleration in np.linspace(1.001, FULL_PERIOD_ACCELERATION_G - 0.01, 40):
        flights = sticking_cycle(float(acceleration))

        assert len(flights) == 1
        assert flights[0].sticks
        assert flights[0].end < flights[0].start + 2 * np.pi


def test_ball_bounces_at_high_acceleration() -> None:
    flights = sticking_cycle(FULL_PERIOD_ACCELERATION_G + 0.05, max_flights=200)

    assert not any(flight.sticks for flight in flights)
    assert all(first.end == second.start for first, second in pairwise(flights))
    # It converges to flights of one period, with take-off where the body's velocity is pi g/w.
    assert flights[-1].end - flights[-1].start == pytest.approx(2 * np.pi, abs=1e-9)
    assert np.cos(flights[-1].start) * (FULL_PERIOD_ACCELERATION_G + 0.05) == pytest.approx(np.pi, abs=1e-9)


def test_bouncing_ball_may_stick_again() -> None:
    # 7.4 g is in a band of several flights before the ball sticks.
    flights = sticking_cycle(7.4)

    assert len(flights) > 1
    assert flights[-1].sticks


def test_acceleration_below_gravity_has_no_separation() -> None:
    with pytest.raises(ValueError, match="never takes off"):
        take_off_phase(0.99)
