"""The completely inelastic ball on a body that moves as a sine."""

from itertools import pairwise

import numpy as np
import pytest

from tests.rig.bouncing_ball import FULL_PERIOD, fly, sequence, take_off


@pytest.mark.parametrize("acceleration", [1.01, 1.5, 2.2, 3.2, 3.6, 5.0, 9.0])
def test_given_a_flight_when_it_ends_then_ball_and_body_meet_for_the_first_time(acceleration: float) -> None:
    start = take_off(acceleration)

    flight = fly(acceleration, start)

    t = np.linspace(0, 1, 4001)[1:-1] * (flight.end - flight.start)
    body = acceleration * np.sin(start + t)
    ball = acceleration * (np.sin(start) + np.cos(start) * t) - t**2 / 2
    assert np.sin(start) * acceleration == pytest.approx(1, abs=1e-12)
    assert (ball > body)[20:].all()
    assert (ball > body - 1e-12).all()
    length = flight.end - start
    gap = acceleration * (np.sin(start) - np.sin(flight.end) + np.cos(start) * length) - length**2 / 2
    assert abs(gap) < 1e-12


def test_given_the_full_period_acceleration_when_the_ball_flies_then_it_lands_one_turn_later() -> None:
    flight = fly(FULL_PERIOD, take_off(FULL_PERIOD))

    assert flight.end - flight.start == pytest.approx(2 * np.pi, abs=1e-9)


def test_given_low_accelerations_when_the_ball_lands_then_it_sticks_and_repeats_every_period() -> None:
    for acceleration in np.linspace(1.001, FULL_PERIOD - 0.01, 40):
        flights = sequence(float(acceleration))

        assert len(flights) == 1
        assert flights[0].sticks
        assert flights[0].end < flights[0].start + 2 * np.pi


def test_given_an_acceleration_beyond_a_full_period_when_the_ball_lands_then_it_leaves_at_once() -> None:
    flights = sequence(FULL_PERIOD + 0.05, longest=200)

    assert not any(flight.sticks for flight in flights)
    assert all(first.end == second.start for first, second in pairwise(flights))
    # It settles on flights of one period each, thrown where the body's speed is pi g/w.
    assert flights[-1].end - flights[-1].start == pytest.approx(2 * np.pi, abs=1e-9)
    assert np.cos(flights[-1].start) * (FULL_PERIOD + 0.05) == pytest.approx(np.pi, abs=1e-9)


def test_given_a_still_higher_acceleration_when_the_ball_hops_then_it_comes_to_ride_again() -> None:
    flights = sequence(7.4)

    assert len(flights) > 1
    assert flights[-1].sticks


def test_given_less_than_gravity_when_asked_for_take_off_then_it_says_that_the_ball_stays() -> None:
    with pytest.raises(ValueError, match="never leaves"):
        take_off(0.99)
