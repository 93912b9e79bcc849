"""Random, multisine, impulse and free decay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from daq.excitation.impulse import half_sine
from rig.errors import SceneError
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

FORCE = {"kind": "force", "body": 1}


def force_in_time(bench_run: BenchRun, first: int, stop: int) -> np.ndarray:
    """Spring force over a window that is taken as periodic, from the spectra of the channels."""
    frequencies = np.fft.rfftfreq(stop - first, 1.0 / bench_run.bench.rate)[1:]
    spectrum = np.fft.rfft(bench_run.readings[:, first:stop], axis=1)[:, 1:]
    weights = np.array([bench_run.weights(frequency) for frequency in frequencies]).T
    # Below the band there is only leakage, amplified by the double integration.
    total = np.where(frequencies > 5.0, np.sum(weights * spectrum, axis=0), 0.0)
    return np.fft.irfft(np.concatenate([[0.0], total]), stop - first)


def test_random_force_has_band_and_level() -> None:
    test = {"kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "30 s"}
    completed = run(scene_with(test, shaker=FORCE))
    drive = completed.drive[0]
    assert drive.size == 30 * 5120
    assert drive.std() == pytest.approx(2.6, rel=0.03)
    power = np.abs(np.fft.rfft(drive)) ** 2
    frequencies = np.fft.rfftfreq(drive.size, 1 / 5120.0)
    inside = (frequencies > 7.5) & (frequencies < 60.5)
    assert power[~inside].sum() < 1e-3 * power.sum()
    halves = power[inside & (frequencies < 34)].sum(), power[inside & (frequencies >= 34)].sum()
    assert halves[0] / halves[1] == pytest.approx(1.0, rel=0.15)
    kurtosis = np.mean((drive / drive.std()) ** 4)
    assert kurtosis == pytest.approx(3.0, abs=0.25)


def test_spring_drive_is_shaped_flat() -> None:
    test = {"kind": "random", "from": "15 Hz", "to": "32 Hz", "force": "2.6 N", "duration": "16 s"}
    completed = run(scene_with(test))
    first, stop, _ = completed.marked("measure")[0]
    force = force_in_time(completed, first, stop)
    assert force.std() == pytest.approx(2.6, rel=0.1)
    assert completed.marked("settle")[0][2]["settled"] is True


def test_bursts_end_in_silence() -> None:
    test = {
        "kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "16 s",
        "burst": "40 %",
    }  # fmt: skip
    completed = run(scene_with(test, shaker=FORCE))
    _, _, fields = completed.marked("measure")[0]
    blocks = completed.drive[0].reshape(-1, fields["block"])
    burst_samples = round(0.4 * fields["block"])
    assert len(blocks) == 2
    assert np.all(blocks[:, burst_samples:] == 0.0)
    assert np.all(blocks[:, :burst_samples].std(axis=1) > 2.0)


@pytest.mark.parametrize("kind", ["random", "multisine"])
def test_seed_determines_random_signal(kind: str) -> None:
    test = {"kind": kind, "from": "8 Hz", "to": "60 Hz", "force": "1 N"}
    test |= {"duration": "4 s"} if kind == "random" else {"period": "1 s", "periods": 2, "realisations": 1}
    drives = [run(scene_with(test, shaker=FORCE, seed=seed)).drive for seed in (1, 1, 2)]
    np.testing.assert_array_equal(drives[0], drives[1])
    assert not np.array_equal(drives[0], drives[2])


def test_realisations_are_periodic_multisines() -> None:
    test = {
        "kind": "multisine", "from": "15 Hz", "to": "32 Hz", "period": "1 s", "periods": 3, "realisations": 2,
        "force": "2.6 N",
    }  # fmt: skip
    completed = run(scene_with(test))
    assert len(completed.marked("measure")) == 2
    phases = []
    for first, stop, fields in completed.marked("measure"):
        assert (fields["period"], fields["periods"], fields["lines"]) == (5120, 3, [15, 32])
        assert stop - first == 3 * 5120
        wave = completed.drive[0, first:stop].reshape(3, -1)
        np.testing.assert_array_equal(wave[0], wave[1])
        spectrum = np.fft.rfft(wave[0])
        assert np.abs(np.delete(spectrum, range(15, 33))).max() < 1e-9 * np.abs(spectrum).max()
        phases.append(np.angle(spectrum[15:33]))
        readings = completed.readings[:, first:stop].reshape(len(completed.readings), 3, -1)
        change = np.sqrt(np.mean((readings[:, 2] - readings[:, 1]) ** 2, axis=1))
        assert np.all(change < 2e-3 * readings[:, 2].std(axis=1))
        force = force_in_time(completed, first, first + 5120)
        assert force.std() == pytest.approx(2.6, rel=0.05)
        lines = np.abs(np.fft.rfft(force))[15:33]
        assert lines.max() / lines.min() < 1.3
    assert np.abs(phases[0] - phases[1]).max() > 0.5


def test_band_has_given_number_of_lines() -> None:
    test = {"kind": "multisine", "from": "8 Hz", "to": "60 Hz", "lines": 27, "periods": 2, "realisations": 1}
    completed = run(scene_with({**test, "force": "2.6 N"}, shaker=FORCE))
    first, last = completed.marked("measure")[0][2]["lines"]
    assert last - first + 1 == 27


def test_band_without_line_is_rejected() -> None:
    test = {"kind": "random", "from": "300.001 Hz", "to": "300.002 Hz", "force": "1 N", "duration": "4 s"}
    with pytest.raises(SceneError, match=r"no line between 300\.001 and 300\.002 Hz"):
        run(scene_with(test, shaker=FORCE, converter={"rate": "1 kHz"}))


@pytest.mark.parametrize("width", [0.45e-3, 1e-3, 4e-3, 4.31e-3, 20e-3])
def test_half_sine_keeps_peak_and_area(width: float) -> None:
    pulse = half_sine(50.0, width, 5120.0)
    assert pulse.max() == 50.0
    assert pulse.sum() / 5120.0 == pytest.approx(50.0 * width * 2 / np.pi, rel=1e-9)
    assert pulse[0] == pulse[-1] == 0.0
    np.testing.assert_allclose(pulse, pulse[::-1], rtol=0, atol=1e-12)


def test_too_short_pulse_is_rejected() -> None:
    with pytest.raises(SceneError, match=r"raise converter\.rate"):
        half_sine(50.0, 0.1e-3, 5120.0)


def impulse(**more: Any) -> BenchRun:
    test = {"kind": "impulse", "body": 2, "peak": "50 N", "width": "4 ms", "repeats": 2, "interval": "1 s", **more}
    return run(rig.load("fig10b-no-damper").replace(test=test))


def test_hits_follow_at_their_interval() -> None:
    completed = impulse()
    assert completed.drive.shape[1] == 1280 + 2 * 5120
    hits = completed.marked("hit")
    assert [first for first, _, _ in hits] == [1280, 1280 + 5120]
    hammer = completed.drive[list(completed.bench.inputs).index("hammer")]
    for first, stop, fields in hits:
        assert fields["peak"] == 50.0 and fields["body"] == 2 and fields["double"] is False
        assert hammer[first:stop].max() == 50.0
        hammer[first:stop] = 0.0
    assert not hammer.any()
    places = [channel.at for channel in completed.bench.channels]
    struck = completed.readings[places.index("body 2")]
    assert np.abs(struck[1280:1400]).max() > 20.0 > np.abs(struck[:1280]).max()


def test_double_hit_bounces_and_is_marked() -> None:
    completed = impulse(double_hit={"hits": [2], "after": "20 ms", "ratio": 0.4})
    hammer = completed.drive[list(completed.bench.inputs).index("hammer")]
    first, second = completed.marked("hit")
    assert not first[2]["double"] and second[2]["double"]
    peaks = [np.sort(np.unique(hammer[start:stop]))[-1] for start, stop, _ in (first, second)]
    assert peaks == [50.0, 50.0]
    after = second[0] + round(20e-3 * 5120)
    assert hammer[after : second[1]].max() == pytest.approx(20.0)


def test_shaker_rests_during_hammer_test() -> None:
    test = {"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "interval": "0.5 s"}
    completed = run(scene_with(test))
    assert not completed.drive[list(completed.bench.inputs).index("shaker")].any()


def test_released_mode_decays_freely() -> None:
    test = {"kind": "free", "mode": 1, "amplitude": "1 mm", "duration": "3 s"}
    completed = run(scene_with(test))
    assert completed.drive.shape[1] == 3 * 5120
    assert not completed.drive.any()
    acceleration = completed.readings[2]
    ratio = np.abs(acceleration[-5120:]).max() / np.abs(acceleration[:5120]).max()
    # The table is fixed, so that the spring belongs to the vibrating system.
    assert 0.3 < ratio < 0.6


@pytest.mark.parametrize(
    "test",
    [
        {"kind": "random", "from": "8 Hz", "to": "60 Hz", "force": "2.6 N", "duration": "5 s"},
        {"kind": "multisine", "from": "8 Hz", "to": "60 Hz", "period": "1 s", "force": "2.6 N", "realisations": 1},
        {"kind": "swept_sine", "from": "30 Hz", "to": "40 Hz", "force": "2.6 N", "duration": "3 s"},
    ],
)
def test_split_does_not_change_readings(test: dict[str, Any]) -> None:
    scene = rig.load("fig8-three-dampers").replace(test=test)
    unsplit, split = run(scene), run(scene, split=511)
    np.testing.assert_array_equal(unsplit.readings, split.readings)
    assert unsplit.marks == split.marks
