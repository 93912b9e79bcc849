"""Detection of triggers in a signal, compared with their specification applied sample by sample."""

from fractions import Fraction
from itertools import combinations
from math import ceil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.extras.ni_device.engines.triggers import (
    AnalogSource,
    AtTime,
    Pulses,
    edge,
    window,
)
from daq.extras.ni_device.values import Slope, WindowCondition

# Few values, so that samples are often equal to levels and limits.
LEVELS = st.integers(-4, 4).map(float)


def first_trigger(samples, skip, is_trigger, is_arming):
    """Return the index of the first triggering sample after an arming sample; the first `skip` cannot trigger."""
    is_armed = False
    for index, sample in enumerate(samples):
        if is_trigger(sample):
            if is_armed and index >= skip:
                return index
            is_armed = False
        elif is_arming(sample):
            is_armed = True
    return None


def find_in_blocks(condition, samples, skip, cuts):
    """Return the index at which the finder detects a trigger in a signal that is divided into blocks at `cuts`."""
    ((_, finder),) = AnalogSource(((0, condition),)).finders()
    first = 0
    for block in np.split(np.array(samples), cuts):
        index = finder.find(block, min(skip - first, block.size)) if first < skip else finder.find(block)
        if index is not None:
            return first + index
        first += block.size
    return None


@given(
    samples=st.lists(LEVELS, min_size=1, max_size=25),
    skip=st.integers(0, 12),
    cuts=st.lists(st.integers(0, 25), max_size=3).map(sorted),
    level=LEVELS,
    hysteresis=st.sampled_from([0.0, 1.0, 3.0]),
    lower=LEVELS,
    height=st.sampled_from([0.0, 1.0, 3.0]),
)
def test_blocks_do_not_change_triggers(samples, skip, cuts, level, hysteresis, lower, height):
    def rising(signal, level):
        return first_trigger(signal, skip, lambda x: x > level, lambda x: x <= level - hysteresis)

    assert find_in_blocks(edge(Slope.RISING, level, hysteresis), samples, skip, cuts) == rising(samples, level)
    mirrored = rising([-x for x in samples], -level)
    assert find_in_blocks(edge(Slope.FALLING, level, hysteresis), samples, skip, cuts) == mirrored
    upper = lower + height
    entering = first_trigger(samples, skip, lambda x: lower <= x <= upper, lambda x: not lower <= x <= upper)
    assert find_in_blocks(window(WindowCondition.ENTERING, lower, upper), samples, skip, cuts) == entering
    leaving = first_trigger(samples, skip, lambda x: not lower <= x <= upper, lambda x: lower <= x <= upper)
    assert find_in_blocks(window(WindowCondition.LEAVING, lower, upper), samples, skip, cuts) == leaving


@pytest.mark.parametrize("cuts", [cuts for n in range(5) for cuts in combinations(range(1, 5), n)])
def test_skipped_trigger_disarms(cuts):
    assert find_in_blocks(edge(Slope.RISING, 0.0, 0.0), [-1.0, 1.0, 1.0, -1.0, 1.0], 2, cuts) == 4
    assert find_in_blocks(edge(Slope.RISING, 0.0, 0.0), [-1.0, 1.0, 1.0, 1.0, 1.0], 2, cuts) is None


@settings(max_examples=40)
@given(
    rate=st.sampled_from([Fraction(2), Fraction(5120), Fraction(10_000, 3), Fraction(51_200), Fraction(7, 2)]),
    frequency=st.sampled_from([Fraction(1), Fraction(3), Fraction(1, 2)]),
    number=st.integers(0, 3000),
    offset=st.integers(-2, 2),
)
def test_next_pulse_is_first_from_sample(rate, frequency, number, offset):
    tick = max(0, ceil(number / frequency * rate / 2) + offset)
    for slope, first in ((Slope.RISING, Fraction(1)), (Slope.FALLING, Fraction(3, 2))):
        edges = ((first + k) / frequency for k in range(number + 3))
        expected = next(ceil(time * rate) for time in edges if time * rate >= tick)
        assert Pulses(slope, float(frequency)).next_instant(tick, float(rate)) == expected


def test_time_trigger_is_at_next_sample():
    start = AtTime(0.3)
    assert [start.next_instant(tick, 1000.0) for tick in (0, 300, 301)] == [300, 300, 301]
    assert AtTime(0.30001).next_instant(0, 1000.0) == 301
