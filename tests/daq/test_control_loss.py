"""What ends a test whose controller has become blind."""

import pytest

import daq
import rig
from rig.errors import RunError


def test_given_clipped_control_channels_when_a_force_is_held_then_the_test_ends_and_says_why(
    tmp_path,
) -> None:
    scene = rig.load("fig9").replace(
        converter={"rate": "2048 Hz", "bits": 24, "range": "5 mV"},
        test={"kind": "stepped_sine", "frequencies": [48.0, 49.0], "force": 3.3},
    )

    with pytest.raises(RunError, match="input table has been overloaded since"):
        daq.record(scene, tmp_path / "clipped.mcap")

    with daq.open(tmp_path / "clipped.mcap") as recording:
        assert any(marker.kind == "overload" for marker in recording.markers)
        assert any(marker.kind == "abort" for marker in recording.markers)
