import numpy as np
import pytest

from daq.signal_chain.channel import ChannelInfo
from rig.errors import RecordingError


def channel(**fields):
    return ChannelInfo(
        **({"name": "c", "at": "body 1", "quantity": "velocity", "sensitivity": 2.0, "rate": 100.0} | fields)
    )


def test_given_poles_and_zeros_when_asked_for_the_response_then_it_is_their_product():
    info = channel(zeros=(0.0,), poles=(-3.0 + 4.0j, -3.0 - 4.0j), gain=25.0)
    s = 2j * np.pi * 7.0
    assert info.response(7.0) == pytest.approx(25.0 * s / (s * s + 6.0 * s + 25.0), rel=1e-14)


def test_given_an_averaging_channel_with_delay_when_asked_then_sinc_and_both_delays_are_in():
    info = channel(average=True, delay=2e-3)
    expected = np.sinc(0.2) * np.exp(-2j * np.pi * 20.0 * (0.5 / 100.0 + 2e-3))
    assert info.response([20.0, 0.0]) == pytest.approx(np.array([expected, 1.0]), rel=1e-14)


def test_given_awkward_figures_when_taken_through_metadata_then_nothing_is_lost():
    info = channel(
        poles=(-0.1 + 1e-17j, -1.0 / 3.0), volts_per_count=10.0 / 2**24, range=5.0, sensor={"model": "0.1 µg"}
    )
    metadata = info.to_metadata()
    assert all(isinstance(value, str) for value in metadata.values())
    assert ChannelInfo.from_metadata(metadata) == info


@pytest.mark.parametrize("damage", [{"gain": "one"}, {"gain": None}])
def test_given_damaged_metadata_when_read_then_the_error_names_the_field(damage):
    metadata = channel().to_metadata() | damage
    with pytest.raises(RecordingError, match="gain"):
        ChannelInfo.from_metadata({key: value for key, value in metadata.items() if value is not None})


def test_given_counts_when_asked_then_their_size_is_in_the_unit_read():
    assert channel(volts_per_count=0.5).unit_per_count == 0.25
    assert channel().unit_per_count == 0.5
