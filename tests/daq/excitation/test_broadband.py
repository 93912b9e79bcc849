"""Random, multisine, impulse and free-decay tests: force, timing and markers on the virtual bench."""

import contextlib
import re
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import rig
from daq.core.excitation.sensor_settling import longest_duration, wait_for_sensors
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import SceneError
from rig.core.scene.excitation.impulse import half_sine
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import sampled_drive
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

RATE = 5120  # sample rate of the scenes, Hz
LEVEL = 2.6  # rms of the force in the tests, N
BASELINE_SAMPLES = 1280  # recorded before the first hit (0.25 s)
FORCE_SHAKER = {"kind": "force", "body": 1}


def force_history(bench_run: BenchRun, first: int, stop: int) -> np.ndarray:
    """Return the spring force in N in a window, which is treated as one period, from the spectra of the channels."""
    frequencies = np.fft.rfftfreq(stop - first, 1.0 / bench_run.bench.rate)[1:]
    spectrum = np.fft.rfft(bench_run.readings[:, first:stop], axis=1)[:, 1:]
    weights = np.array([bench_run.force_weights(frequency) for frequency in frequencies]).T
    # Below the band (here below 5 Hz) there is only leakage, which the double integration amplifies.
    force_spectrum = np.where(frequencies > 5.0, np.sum(weights * spectrum, axis=0), 0.0)
    return np.fft.irfft(np.concatenate([[0.0], force_spectrum]), stop - first)


def test_random_force_has_band_and_level() -> None:
    test = {"kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "30 s"}
    bench_run = run(scene_with(test, shaker=FORCE_SHAKER))
    drive = bench_run.drive[0]
    assert drive.size == 30 * RATE
    assert drive.std() == pytest.approx(LEVEL, rel=0.03)
    power = np.abs(np.fft.rfft(drive)) ** 2
    frequencies = np.fft.rfftfreq(drive.size, 1 / RATE)
    in_band = (frequencies > 7.5) & (frequencies < 60.5)  # with the 0.25 Hz resolution of the shaping filter
    assert power[~in_band].sum() < 1e-3 * power.sum()
    lower_half, upper_half = power[in_band & (frequencies < 34)].sum(), power[in_band & (frequencies >= 34)].sum()
    assert lower_half / upper_half == pytest.approx(1.0, rel=0.15)
    # The kurtosis of Gaussian noise is 3.
    kurtosis = np.mean((drive / drive.std()) ** 4)
    assert kurtosis == pytest.approx(3.0, abs=0.25)


def test_random_spring_force_has_required_level() -> None:
    test = {"kind": "random", "from": "15 Hz", "to": "32 Hz", "force": "2.6 N", "duration": "8 s"}
    bench_run = run(scene_with(test))
    first, stop, _ = bench_run.marks_of("measure")[0]
    force = force_history(bench_run, first, stop)
    assert force.std() == pytest.approx(LEVEL, rel=0.1)
    assert bench_run.marks_of("settle")[0][2]["settled"] is True


def test_clipped_samples_of_several_shakers_are_counted_once() -> None:
    shaker = {"kind": "electrodynamic", "spring": "6.6 kN/m", "amplifier": {"limit": "10 mV"}}
    test = {
        "kind": "random",
        "from": "8 Hz",
        "to": "60 Hz",
        "drive": "1 V",
        "duration": "1 s",
        "shaker": 1,
        "also": [2],
    }
    bench_run = run(scene_with(test, shaker=[{**shaker, "body": 1}, {**shaker, "body": 3}]))
    (warning,) = bench_run.warnings
    n_clipped, n_samples = (int(number) for number in re.findall(r"\b\d+\b", warning))
    assert 0.9 * RATE < n_clipped <= n_samples == RATE


def test_drive_is_zero_after_each_burst() -> None:
    test = {
        "kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "16 s",
        "burst": "40 %",
    }  # fmt: skip
    bench_run = run(scene_with(test, shaker=FORCE_SHAKER))
    _, _, fields = bench_run.marks_of("measure")[0]
    blocks = bench_run.drive[0].reshape(-1, fields["block"])
    burst_samples = round(0.4 * fields["block"])
    assert len(blocks) == 2
    assert np.all(blocks[:, burst_samples:] == 0.0)
    assert np.all(blocks[:, :burst_samples].std(axis=1) > 0.75 * LEVEL)


@pytest.mark.parametrize("kind", ["random", "multisine"])
def test_seed_determines_random_signal(kind: str) -> None:
    test = {"kind": kind, "from": "8 Hz", "to": "60 Hz", "force": "1 N"}
    test |= {"duration": "4 s"} if kind == "random" else {"period": "1 s", "periods": 2, "realisations": 1}
    drives = [run(scene_with(test, shaker=FORCE_SHAKER, seed=seed)).drive for seed in (1, 1, 2)]
    np.testing.assert_array_equal(drives[0], drives[1])
    assert not np.array_equal(drives[0], drives[2])


def test_realisations_are_periodic_multisines() -> None:
    test = {
        "kind": "multisine", "from": "15 Hz", "to": "32 Hz", "period": "1 s", "periods": 3, "realisations": 2,
        "force": "2.6 N",
    }  # fmt: skip
    bench_run = run(scene_with(test))
    assert len(bench_run.marks_of("measure")) == 2
    phases = []
    for first, stop, fields in bench_run.marks_of("measure"):
        assert (fields["period"], fields["periods"], fields["lines"]) == (RATE, 3, [15, 32])
        assert stop - first == 3 * RATE
        drive_periods = bench_run.drive[0, first:stop].reshape(3, -1)
        np.testing.assert_array_equal(drive_periods[0], drive_periods[1])
        spectrum = np.fft.rfft(drive_periods[0])
        assert np.abs(np.delete(spectrum, range(15, 33))).max() < 1e-9 * np.abs(spectrum).max()
        phases.append(np.angle(spectrum[15:33]))
        readings = bench_run.readings[:, first:stop].reshape(len(bench_run.readings), 3, -1)
        change = np.sqrt(np.mean((readings[:, 2] - readings[:, 1]) ** 2, axis=1))
        assert np.all(change < 2e-3 * readings[:, 2].std(axis=1))
        force = force_history(bench_run, first, first + RATE)
        assert force.std() == pytest.approx(LEVEL, rel=0.05)
        line_amplitudes = np.abs(np.fft.rfft(force))[15:33]
        assert line_amplitudes.max() / line_amplitudes.min() < 1.3
    assert np.abs(phases[0] - phases[1]).max() > 0.5


def test_multisine_has_given_number_of_lines() -> None:
    test = {"kind": "multisine", "from": "8 Hz", "to": "60 Hz", "lines": 27, "periods": 2, "realisations": 1}
    bench_run = run(scene_with({**test, "force": "2.6 N"}, shaker=FORCE_SHAKER))
    first, last = bench_run.marks_of("measure")[0][2]["lines"]
    assert last - first + 1 == 27


def test_band_without_line_is_rejected() -> None:
    test = {"kind": "random", "from": "300.001 Hz", "to": "300.002 Hz", "force": "1 N", "duration": "4 s"}
    with pytest.raises(SceneError, match=r"no spectral line between 300\.001 and 300\.002 Hz"):
        run(scene_with(test, shaker=FORCE_SHAKER, converter={"rate": "1 kHz"}))


@pytest.mark.parametrize("width", [0.45e-3, 1e-3, 4e-3, 4.31e-3, 20e-3])
def test_half_sine_keeps_peak_and_area(width: float) -> None:
    pulse = half_sine(50.0, width, RATE)
    assert pulse.max() == 50.0
    assert pulse.sum() / RATE == pytest.approx(50.0 * width * 2 / np.pi, rel=1e-9)
    assert pulse[0] == pulse[-1] == 0.0
    np.testing.assert_allclose(pulse, pulse[::-1], rtol=0, atol=1e-12)


def test_too_short_pulse_is_rejected() -> None:
    with pytest.raises(SceneError, match=r"raise the sample rate \(converter\.rate\)"):
        half_sine(50.0, 0.1e-3, RATE)


def run_hits(**changes: Any) -> BenchRun:
    """Run a test with two hammer hits on body 2."""
    test = {"kind": "impulse", "body": 2, "peak": "50 N", "width": "4 ms", "repeats": 2, "interval": "1 s", **changes}
    return run(rig.load("fig10b-no-damper").replace(test=test))


def test_simulated_hits_equal_recorded_hits() -> None:
    bench_run = run_hits(double_hit={"hits": [2]})
    scene = bench_run.bench.scene
    system = assemble(scene)
    row = system.inputs.index("hammer")
    recorded = bench_run.drive[row, BASELINE_SAMPLES:]
    assert np.count_nonzero(recorded[RATE:]) > 1.5 * np.count_nonzero(recorded[:RATE])
    np.testing.assert_array_equal(sampled_drive(scene, system, recorded.size, RATE)[row], recorded)


def test_hits_follow_at_their_interval() -> None:
    bench_run = run_hits()
    assert bench_run.drive.shape[1] == BASELINE_SAMPLES + 2 * RATE
    hits = bench_run.marks_of("hit")
    assert [first for first, _, _ in hits] == [BASELINE_SAMPLES, BASELINE_SAMPLES + RATE]
    hammer = bench_run.drive[list(bench_run.bench.inputs).index("hammer")]
    for first, stop, fields in hits:
        assert fields["peak"] == 50.0 and fields["body"] == 2 and fields["double"] is False
        assert hammer[first:stop].max() == 50.0
        hammer[first:stop] = 0.0
    assert not hammer.any()
    positions = [channel.at for channel in bench_run.bench.channels]
    acceleration = bench_run.readings[positions.index("body 2")]
    # Only the hit causes an acceleration above 20 m/s^2; it is evaluated for 120 samples (23 ms).
    assert (
        np.abs(acceleration[BASELINE_SAMPLES : BASELINE_SAMPLES + 120]).max()
        > 20.0
        > np.abs(acceleration[:BASELINE_SAMPLES]).max()
    )


def test_each_hit_has_its_listed_peak() -> None:
    bench_run = run_hits(peak=["50 N", "80 N"], double_hit={"hits": [2], "ratio": 0.5})
    hammer = bench_run.drive[list(bench_run.bench.inputs).index("hammer")]
    marks = bench_run.marks_of("hit")
    assert [(hammer[start:stop].max(), fields["peak"]) for start, stop, fields in marks] == [(50.0, 50.0), (80.0, 80.0)]
    assert hammer[marks[1][0] + round(20e-3 * RATE) :].max() == pytest.approx(40.0)


def test_level_of_listed_peaks_is_the_highest() -> None:
    test = (
        rig.load("fig10b-no-damper")
        .replace(test={"kind": "impulse", "body": 1, "peak": ["50 N", "80 N"], "width": "4 ms", "repeats": 2})
        .test
    )
    assert max(test.levels) == 80.0 and test.at_level(40.0).peak == (25.0, 40.0)


def test_double_hit_is_applied_and_marked() -> None:
    bench_run = run_hits(double_hit={"hits": [2], "after": "20 ms", "ratio": 0.4})
    hammer = bench_run.drive[list(bench_run.bench.inputs).index("hammer")]
    first, second = bench_run.marks_of("hit")
    assert not first[2]["double"] and second[2]["double"]
    assert [hammer[start:stop].max() for start, stop, _ in (first, second)] == [50.0, 50.0]
    rebound = second[0] + round(20e-3 * RATE)
    # 40 % of the first peak of 50 N.
    assert hammer[rebound : second[1]].max() == pytest.approx(20.0)


@pytest.mark.parametrize(("bias_settling", "is_settled"), [("2 s", True), ("100 s", False)])
def test_drift_at_longest_wait_is_not_settled(bias_settling: str, is_settled: bool) -> None:
    sensor = {"accelerometer.bias": "9 V", "accelerometer.bias_settling": bias_settling}
    station = Mock(channels=[ChannelInfo("a1", "body 2", "acceleration", 1.0, 100.0, sensor=sensor)], rate=100.0, now=0)
    station.samples, station.zero_drive = lambda seconds: round(100.0 * seconds), lambda samples: samples
    wait = wait_for_sensors(station)
    samples = next(wait)
    while not station.mark.called:
        station.now += samples
        samples = wait.send(np.arange(50.0)[None])  # a drift without noise
    assert station.mark.call_args.kwargs["settled"] is is_settled


def test_longest_duration_is_that_of_the_wait() -> None:
    sensor = {"accelerometer.bias": "9 V", "accelerometer.bias_settling": "0.2 s"}
    channels = [ChannelInfo("a1", "body 2", "acceleration", 1.0, 100.0, sensor=sensor)]
    station = Mock(channels=channels, rate=100.0, now=0)
    station.samples, station.zero_drive = lambda seconds: round(100.0 * seconds), lambda samples: samples
    wait, readings = wait_for_sensors(station), None
    with contextlib.suppress(StopIteration):
        while True:
            station.now += wait.send(readings)
            readings = np.arange(50.0)[None]  # a drift without noise
    assert station.now / 100.0 == longest_duration(channels) == 2.25


def test_shaker_is_not_driven_during_hammer_test() -> None:
    test = {"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "interval": "0.5 s"}
    bench_run = run(scene_with(test))
    assert not bench_run.drive[list(bench_run.bench.inputs).index("shaker")].any()


def test_released_mode_decays_freely() -> None:
    test = {"kind": "free", "mode": 1, "amplitude": "1 mm", "duration": "3 s"}
    bench_run = run(scene_with(test))
    assert bench_run.drive.shape[1] == 3 * RATE
    assert not bench_run.drive.any()
    acceleration = bench_run.readings[2]
    # Ratio of the largest accelerations in the last and in the first second.
    ratio = np.abs(acceleration[-RATE:]).max() / np.abs(acceleration[:RATE]).max()
    # The decay is exp(-2 pi 13.8 Hz 0.5 % 2 s) = 0.42 for mode 1. The table is fixed, so that the coil spring stiffens
    # body 1.
    assert 0.3 < ratio < 0.6


@pytest.mark.parametrize(
    "test",
    [
        {"kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "2 s"},
        {"kind": "multisine", "from": "8 Hz", "to": "60 Hz", "period": "1 s", "force": "2.6 N", "realisations": 1},
        {"kind": "swept_sine", "from": "30 Hz", "to": "40 Hz", "force": "2.6 N", "duration": "1.5 s"},
    ],
)
def test_block_size_does_not_change_readings(test: dict[str, Any]) -> None:
    scene = rig.load("fig8-three-dampers").replace(test=test)
    undivided_run, divided_run = run(scene), run(scene, max_block=511)
    np.testing.assert_array_equal(undivided_run.readings, divided_run.readings)
    assert undivided_run.marks == divided_run.marks
