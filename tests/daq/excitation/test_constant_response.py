"""Response-controlled stepped sine: the law of its control, runs on the bench, and comparison with exact orbits."""

from typing import Any

import numpy as np
import pytest

import daq
import rig
from daq.core.excitation.tones.envelope_control import EnvelopeControl
from rig.core.base.errors import RunError, SceneError
from rig.core.system.structural_model import receptance
from tests.daq.excitation.virtual_device import run_device
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

LEVEL = 0.4e-3  # m
TEST = {"kind": "constant_response", "at": "body 2", "displacement": LEVEL, "frequencies": [48.0, 49.0, 50.0]}


def motion(bench_run: BenchRun, at: str) -> list[float]:
    """Return the displacement amplitude of a body in each measurement, m."""
    row = [channel.at for channel in bench_run.bench.channels].index(at)
    return [
        abs(bench_run.amplitudes(first, stop, f)[row] * bench_run.displacement_factor(row, f))
        for first, stop, fields in bench_run.marks_of("measure")
        for f in (fields["frequency"],)
    ]


@pytest.mark.parametrize("rotation", [-30.0, 0.0, 30.0])
@pytest.mark.parametrize("scale", [1 / 1.5, 1.0, 1.5])
def test_law_holds_unstable_envelope(rotation: float, scale: float) -> None:
    # Hardening spring, 13 Hz, damping 0.5 %: three decay rates above the mode, dU/d|X| is negative.
    decay, gain, window = 0.41, 1.0, 0.15
    offset, hardening = 6.0 * decay, 3.0 * decay
    estimate = scale * gain * np.exp(1j * np.deg2rad(rotation))
    envelope, drive, following, step = 1.02 + 0j, 0.3 + 0.5j, 0.3 + 0.5j, window / 50
    slope = decay**2 + (hardening - offset) * (3.0 * hardening - offset)
    assert slope < 0.0  # of |b U|^2 over |X|^2
    control = EnvelopeControl(1.0, drive, window, 1.5 * window)
    for _ in range(300):
        mean = 0j
        for k in range(50):
            present = drive + (following - drive) * (1.0 - np.cos(np.pi * k / 50)) / 2.0
            pole = -decay + 1j * (hardening * abs(envelope) ** 2 - offset)
            envelope += step * (pole * envelope + gain * present)
            mean += envelope / 50
        drive = following
        following = control.next_drive(mean, estimate)
    exact = abs(-decay + 1j * (hardening - offset)) / gain
    assert abs(envelope - 1.0) < 1e-3
    assert abs(drive) == pytest.approx(exact, rel=2e-3)


def test_law_limits_drive_at_excess() -> None:
    control = EnvelopeControl(1.0, 1.0 + 0j, 0.1, 0.15, limit=5.0)
    assert abs(control.next_drive(2.0, -1.0)) <= 1.0


@pytest.fixture(scope="module")
def held() -> BenchRun:
    return run(rig.load("held-response").replace(test=TEST))


def test_motion_is_at_level(held: BenchRun) -> None:
    assert motion(held, "body 2") == pytest.approx([LEVEL] * 3, rel=0.006)
    assert all(fields["settled"] for *_, fields in held.marks_of("measure"))
    assert not held.warnings


def test_drive_ends_at_zero(held: BenchRun) -> None:
    assert abs(held.drive[0, -1]) < 1e-4 * abs(held.drive).max()


def test_points_are_exact_orbits(held: BenchRun) -> None:
    for amplitude, (*_, fields) in zip(motion(held, "body 2"), held.marks_of("measure"), strict=True):
        frequency, drive = fields["frequency"], fields["drive"]
        theory = held.bench.scene.replace(test={"kind": "sine", "frequency": frequency, "force": drive}, channels=None)
        curve = rig.follow_orbits(theory, "force", (0.9 * drive, 1.1 * drive), frequency=frequency)
        errors = []
        for branch in curve.branches:
            exact = np.array([abs(orbit.frf[1] * orbit.reference_amplitude) for orbit in branch.orbits])
            for k in np.flatnonzero((exact[1:] - amplitude) * (exact[:-1] - amplitude) <= 0.0):
                share = (amplitude - exact[k]) / (exact[k + 1] - exact[k])
                errors.append(abs((branch.value[k] + share * np.diff(branch.value)[k]) / drive - 1.0))
        assert min(errors) < 3e-3


def test_coil_shaker_with_noise_is_held() -> None:
    scene = rig.load("fig9").replace(test={**TEST, "frequencies": [49.0, 49.6]})
    assert motion(run(scene), "body 2") == pytest.approx([LEVEL] * 2, rel=0.006)


def test_linear_response_is_exact() -> None:
    test = {
        "kind": "constant_response",
        "at": "body 3",
        "velocity": "0.05 m/s",
        "frequencies": [12.5, 13.2, 13.8, 14.2],
    }
    bench_run = run(scene_with(test))
    frequencies = np.array(test["frequencies"])
    exact = receptance(bench_run.bench.scene, frequencies)
    for k, (first, stop, fields) in enumerate(bench_run.marks_of("measure")):
        amplitudes = bench_run.amplitudes(first, stop, fields["frequency"])
        force = amplitudes @ bench_run.force_weights(fields["frequency"])
        value = amplitudes[2] * bench_run.displacement_factor(2, fields["frequency"]) / force
        assert abs(value / exact[2, k] - 1.0) < 0.004
    assert motion(bench_run, "body 3") == pytest.approx(0.05 / (2 * np.pi * frequencies), rel=0.006)


def test_device_gives_equal_markers(held: BenchRun) -> None:
    assert run_device(held.bench.scene, 0) == held.marks


def test_delayed_device_gives_same_points(held: BenchRun) -> None:
    delayed = [fields for kind, *_, fields in run_device(held.bench.scene, 256) if kind == "measure"]
    direct = [fields for *_, fields in held.marks_of("measure")]
    assert [fields["frequency"] for fields in delayed] == [fields["frequency"] for fields in direct]
    assert [fields["drive"] for fields in delayed] == pytest.approx([fields["drive"] for fields in direct], rel=0.01)


def test_limited_amplifier_gives_up(tmp_path: Any) -> None:
    scene = rig.load("fig9").replace(test={**TEST, "frequencies": [40.0, 41.0], "settle": {"longest": "4 s"}})
    assert scene.shaker is not None
    scene = scene.replace(shaker=scene.shaker.replace(amplifier={"limit": 0.01}))
    with pytest.raises(RunError, match=r"at no frequency.*of the level at 40 to 41 Hz: the amplifier is at its limit"):
        daq.record(scene, tmp_path / "held.mcap")
    with daq.open(tmp_path / "held.mcap") as rec:
        assert rec.markers[-1].kind == "abort"
        assert np.isfinite(rec.read("body2")).all()


def test_missing_channel_is_named() -> None:
    scene = rig.load("held-response")
    assert scene.channels is not None
    with pytest.raises(SceneError, match="controlling the motion requires a motion channel at the body 2"):
        run(scene.replace(channels=[scene.channels[0]]))


def test_missing_body_is_named() -> None:
    with pytest.raises(SceneError, match="body 7 does not exist"):
        rig.load("held-response", {"test.at": "body 7"})


def test_level_is_no_open_loop_drive() -> None:
    with pytest.raises(SceneError, match="depends on measured values"):
        rig.frequency_response("held-response", [49.0])
    with pytest.raises(SceneError, match="generated during a recording"):
        rig.simulate("held-response", 0.1)


def test_test_is_foreseen() -> None:
    foresight = str(daq.foresee(rig.load("held-response")))
    assert "test.displacement" in foresight and "damper 1 (body 2) flies" in foresight
