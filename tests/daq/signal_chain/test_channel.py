"""Description of a channel: its frequency response, its metadata, and its reading per count."""

import numpy as np
import pytest

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError


def channel(**fields):
    """Return a velocity channel with 2 V per m/s at 100 Hz, except for the given fields."""
    return ChannelInfo(
        **({"name": "c", "at": "body 1", "quantity": "velocity", "sensitivity": 2.0, "rate": 100.0} | fields)
    )


def test_response_is_the_product_of_roots():
    info = channel(zeros=(0.0,), poles=(-3.0 + 4.0j, -3.0 - 4.0j), gain=25.0)
    s = 2j * np.pi * 7.0
    assert info.response(7.0) == pytest.approx(25.0 * s / (s * s + 6.0 * s + 25.0), rel=1e-14)


def test_averaging_and_delay_are_in_the_response():
    frequency, delay = 20.0, 2e-3
    info = channel(average=True, delay=delay)
    # An average over a sample interval delays by half the interval.
    expected = np.sinc(frequency / info.rate) * np.exp(-2j * np.pi * frequency * (0.5 / info.rate + delay))
    assert info.response([frequency, 0.0]) == pytest.approx(np.array([expected, 1.0]), rel=1e-14)


def test_metadata_is_lossless():
    info = channel(
        poles=(-0.1 + 1e-17j, -1.0 / 3.0), volts_per_count=10.0 / 2**24, range=5.0, sensor={"model": "0.1 µg"}
    )
    metadata = info.to_metadata()
    assert all(isinstance(value, str) for value in metadata.values())
    assert ChannelInfo.from_metadata(metadata) == info


@pytest.mark.parametrize("damage", [{"gain": "one"}, {"gain": None}])
def test_damaged_metadata_names_the_field(damage):
    metadata = channel().to_metadata() | damage
    with pytest.raises(RecordingError, match="gain"):
        ChannelInfo.from_metadata({key: value for key, value in metadata.items() if value is not None})


def test_unit_per_count_includes_sensitivity():
    # The sensitivity is 2 V per unit; without counts, the result is per volt.
    assert channel(volts_per_count=0.5).unit_per_count == 0.5 / 2.0
    assert channel().unit_per_count == 1.0 / 2.0
