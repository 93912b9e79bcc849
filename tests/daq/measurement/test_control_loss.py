"""A test ends if inputs of the controller are overloaded or a limit is reached; the error names the cause.

The bias is the constant voltage at the output of an IEPE sensor.
"""

import pytest

import daq
import rig
from rig.core.base.errors import RunError
from tests.daq.measurement.bench_run import run


def test_clipped_control_channel_ends_test(tmp_path) -> None:
    scene = rig.load("fig9").replace(
        converter={"rate": "2048 Hz", "bits": 24, "range": "5 mV"},
        test={"kind": "stepped_sine", "frequencies": [48.0, 49.0], "force": 3.3},
    )

    with pytest.raises(RunError, match="input table: overloaded since"):
        daq.record(scene, tmp_path / "clipped.mcap")

    with daq.open(tmp_path / "clipped.mcap") as recording:
        assert any(marker.kind == "overload" for marker in recording.markers)
        assert any(marker.kind == "abort" for marker in recording.markers)


# The bias of these sensors, 9 V, exceeds the range of the converter.
BIASED = """
structure: {masses: [0.74 kg, 0.71 kg], springs: [24.3 kN/m, 21.8 kN/m], damping: {modal: 2 %}}
shaker: {kind: table, body: 1, spring: 6.6 kN/m}
test: {kind: stepped_sine, frequencies: [45 Hz], force: 3.3 N}
channels:
  - {name: body1, at: body 1, accelerometer: {preset: PCB 352C33}}
  - {name: table, at: table, accelerometer: {preset: PCB 352C33}}
converter: {rate: 5120 Hz, bits: 24, range: 5 V}
"""
INTEGRATOR = ", integrator: {order: 2, corner: 1 Hz, gain: 1000"


@pytest.mark.parametrize(
    ("integrator", "cause"),
    [
        (
            f"{INTEGRATOR}}}",
            r"overloads the input after integration even with .* rest. Set bias: 0 V .* higher low_cutoff",
        ),
        ("", r"overloads the input even with .* rest. Set bias: 0 V .* coupling: AC in the converter, or a larger"),
    ],
)
def test_error_names_bias_and_remedies(integrator, cause, tmp_path) -> None:
    scene = rig.loads(BIASED.replace("PCB 352C33}", "PCB 352C33}" + integrator))
    with pytest.raises(RunError, match=rf"bias of its sensor, 9 V \(time constant 2 s\), {cause}"):
        daq.record(scene, tmp_path / "biased.mcap")


@pytest.mark.parametrize(
    "corrected",
    [
        BIASED.replace("PCB 352C33}", "PCB 352C33, bias: 0 V}" + INTEGRATOR + "}"),
        BIASED.replace("PCB 352C33}", "PCB 352C33}" + INTEGRATOR + ", low_cutoff: 5 Hz}"),
        BIASED.replace("5120 Hz", "5120 Hz, coupling: AC"),
    ],
    ids=["no bias", "low cut-off", "AC coupling"],
)
def test_named_remedy_works(corrected, tmp_path) -> None:
    with daq.open(daq.record(rig.loads(corrected), tmp_path / "corrected.mcap")) as recording:
        assert [marker.fields["settled"] for marker in recording.markers if marker.kind == "measure"] == [True]


def test_error_does_not_name_small_bias(tmp_path) -> None:
    scene = rig.loads(BIASED.replace("range: 5 V", "range: 5 mV").replace("PCB 352C33}", "PCB 352C33, bias: 1 mV}"))
    with pytest.raises(RunError, match="Choose a lower force, a larger converter range"):
        daq.record(scene, tmp_path / "clipped.mcap")


def test_overload_is_named_before_its_effect() -> None:
    # The bias overloads the input after integration, so the phase of the motion is wrong and the tone does not lock.
    scene = rig.load("backbone")
    sensor = {"sensitivity": "100 mV/g", "bias": "10 V", "bias_settling": "2 s"}
    amplifier = {"order": 2, "corner": "0.5 Hz", "gain": 100}
    scene = scene.replace(
        channels=[
            {"name": "x", "at": "body 1", "accelerometer": sensor, "integrator": amplifier},
            {"name": "force", "at": "shaker", "hammer": {"sensitivity": "10 mV/N"}},
        ],
        test=scene.test.replace(settle={"longest": 1.0}),
    )
    result = run(scene)
    reason = result.reason
    assert reason.startswith("input x was overloaded, which may be the cause. The bias of its sensor, 10 V")
    assert reason.index("Set bias: 0 V") < reason.index("The test ended: level") < reason.index("no lock within 1 s")


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("backbone", "10 um"),
        ("held-response", "10 um"),
        ("continuation", "10 um"),
        ("shaker-table-sine", "0.5 m/s^2"),
        ("shaker-table-random", "0.5 m/s^2"),
        ("shaker-table-shock", "0.5 m/s^2"),
    ],
)
def test_abort_limit_leaves_recording_and_no_drive(name, limit, tmp_path) -> None:
    scene = rig.load(name)
    first, *others = scene.channels
    scene = scene.replace(channels=[first.replace(abort=limit), *others])
    path = tmp_path / "aborted.mcap"
    with pytest.raises(RunError, match="exceeds its abort limit"):
        daq.record(scene, path)
    with daq.open(path) as recording:
        assert recording.markers[-1].kind == "abort"
        assert recording.read(first.name, 0, recording.markers[-1].first_sample).any()
    drive = run(scene).drive
    # The ramp to zero takes 50 ms.
    assert abs(drive).max() > 0.0 and not drive[:, -1].any()
