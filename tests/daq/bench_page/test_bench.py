"""The bench page with a clock that advances on request: signal output, display and recording."""

import contextlib
import json
import re
import socket
import threading
import webbrowser
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import TaskMode

import analysis
import daq
import rig
from daq.core.drawing.rig_view import RigMotion
from daq.core.recording.committed_file import RESERVE, CommittedFile
from daq.extras.bench_page.bench import _open_browser, _serve_page
from daq.extras.bench_page.half_power import largest_peaks, live_peaks
from daq.extras.bench_page.live_bench import LiveBench
from daq.extras.bench_page.live_frf import RELATIONS, LiveCurves, LiveFrf
from daq.extras.bench_page.page import Page
from daq.extras.bench_page.rig_svg import RigDrawing
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_device.engines.log import MarkedRecording
from daq.extras.ni_server.connection import connect
from rig.core.base.errors import RunError, SceneError
from rig.core.scene.yaml_reader import read_yaml

BRACKET = """\
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [839 kN/m, 964 kN/m], damping: {modal: 0.7 %}}
channels:
  - {name: base, at: body 1, accelerometer: &sensor {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: arm, at: body 2, accelerometer: *sensor}
  - {name: force, at: PLACE, hammer: {sensitivity: 11 mV/N}}
converter: {rate: 1024 Hz, bits: 24, range: 5 V}
"""
SHAKER_TEST = "shaker: {kind: force, body: 1}\ntest: {kind: sine, frequency: 62 Hz, force: 10 N}\n"
HAMMER_TEST = (
    "test: {kind: impulse, body: 1, peak: 100 N, width: 8 ms, repeats: 3, interval: 2 s, double_hit: {hits: [2]}}\n"
)


def make_scene(kind):
    """Return the scene of a hammer test, or of a test by shaker."""
    place, test = ("hammer", HAMMER_TEST) if kind == "hammer" else ("shaker", SHAKER_TEST)
    return rig.load(read_yaml(BRACKET.replace("PLACE", place) + test).content)


@pytest.fixture
def bench(request, tmp_path):
    chassis = connect_scene(make_scene(request.param), "manual")
    live_bench = LiveBench(chassis, "", tmp_path / "test.mcap", False)
    live_bench.controller.settings.kind = request.param
    yield live_bench
    with contextlib.suppress(ValueError):
        live_bench.close()


def pass_time(bench, seconds):
    """Advance the clock by a time in s, and wait until the display is up to date."""
    for _ in range(round(seconds / 0.1)):
        bench.chassis.clock.advance(0.1)
        bench.monitor.catch_up()


def test_scene_without_input_is_reported_at_start(tmp_path):
    chassis = connect_scene(make_scene("shaker").replace(shaker=None, test=None, channels=None), "manual")
    live_bench = LiveBench(chassis, "", tmp_path / "none.mcap", False)
    try:
        live_bench.controller.start()
        assert "neither a shaker nor a hammer" in live_bench.controller.message
    finally:
        live_bench.close()


@pytest.mark.parametrize("bench", ["shaker"], indirect=True)
def test_bench_stands_still_while_its_state_is_read(bench, monkeypatch):
    changed, acquired = bench.chassis.changed, []

    def remaining(_):
        other = threading.Thread(target=lambda: acquired.append(changed.acquire(blocking=False)))
        other.start()
        other.join()

    monkeypatch.setattr(type(bench.controller), "remaining", property(remaining))
    Page(bench).refresh()
    assert acquired == [False]


@pytest.mark.parametrize("bench", ["shaker"], indirect=True)
def test_stuck_display_does_not_delay_the_bench(bench, monkeypatch):
    released, monitor = threading.Event(), bench.monitor
    monkeypatch.setattr(monitor, "_process", lambda *_: released.wait())
    block = SimpleNamespace(first=0, samples=np.zeros((3, 0)))
    sends_blocks = threading.Thread(target=lambda: [monitor.on_block(bench.chassis.bench, block) for _ in range(300)])
    sends_blocks.start()
    sends_blocks.join(10.0)
    is_delayed = sends_blocks.is_alive()
    released.set()
    sends_blocks.join()
    monitor.catch_up()
    # 256 blocks wait, and one may be in the display.
    assert not is_delayed and monitor.skipped_blocks in (43, 44)


@pytest.mark.parametrize("bench", ["shaker"], indirect=True)
def test_stuck_display_does_not_prevent_closing(bench, monkeypatch, capsys):
    released, monitor = threading.Event(), bench.monitor
    monitor.catch_up()
    monkeypatch.setattr(monitor, "_process", lambda *_: released.wait())
    monkeypatch.setattr("daq.extras.ni_server.live.MAX_CLOSING_S", 0.0)
    block = SimpleNamespace(first=0, samples=np.zeros((3, 0)))
    for _ in range(300):
        monitor.on_block(bench.chassis.bench, block)
    closes = threading.Thread(target=monitor.close, daemon=True)
    closes.start()
    closes.join(10.0)
    is_closed = not closes.is_alive()
    released.set()
    assert is_closed and "blocks of samples were not shown" in capsys.readouterr().err


def set_controls(bench, **settings):
    """Enter settings on the page."""
    for name, value in settings.items():
        setattr(bench.controller.settings, name, value)


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_recorded_sweep_has_the_resonance(bench):
    set_controls(bench, level=5.0, low=50.0, high=75.0, duration=20.0)
    bench.recordings.enabled = True
    bench.controller.start()
    assert bench.controller.running
    pass_time(bench, 25.0)
    assert not bench.controller.running and bench.controller.message == "sweep test completed"
    live = bench.monitor.frf.curves()
    bench.close()
    (path,) = bench.recordings.paths
    with daq.open(path) as recording:
        assert recording.test.kind == "sweep"
        assert recording.scene.test.kind == "swept_sine"
        frf = analysis.frfs(recording)["arm"]
        resonance = frf.frequency[np.argmax(abs(frf.value))]
        assert resonance == pytest.approx(62.0, abs=0.3)
    assert live.names == ["base", "arm"]
    # The lines of the live estimate are 0.5 Hz apart.
    assert live.frequency[np.nanargmax(abs(live.value[1]))] == pytest.approx(resonance, abs=1.0)
    assert np.nanmedian(live.coherence) > 0.99


@pytest.mark.parametrize("bench", ["random"], indirect=True)
def test_stopped_random_test_leaves_a_readable_recording(bench):
    set_controls(bench, level=5.0, low=20.0, high=200.0, duration=60.0)
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 9.0)
    averages = bench.monitor.frf.curves().averages
    pass_time(bench, 6.0)
    assert bench.monitor.frf.curves().averages > averages
    bench.controller.stop()
    pass_time(bench, 5.0)
    assert not bench.controller.running
    assert bench.monitor.drive_levels()[0][0] == 0.0
    bench.close()
    with daq.open(bench.recordings.paths[0]) as recording:
        recording.check()
        assert analysis.frfs(recording)["arm"].frequency.size


@pytest.mark.parametrize("bench", ["sine"], indirect=True)
def test_sine_follows_frequency_and_level(bench):
    set_controls(bench, level=5.0, frequency=40.0)
    bench.controller.start()
    pass_time(bench, 5.0)
    (peak, frequency), *_ = bench.monitor.drive_levels()
    assert (peak, frequency) == (pytest.approx(5.0, rel=0.01), pytest.approx(40.0, rel=0.001))  # N, Hz
    set_controls(bench, frequency=50.0, level=2.0)
    bench.controller.apply_settings()
    pass_time(bench, 5.0)
    (peak, frequency), *_ = bench.monitor.drive_levels()
    assert (peak, frequency) == (pytest.approx(2.0, rel=0.01), pytest.approx(50.0, rel=0.001))


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_frequencies_ahead_of_the_sweep_are_empty(bench):
    set_controls(bench, level=5.0, low=50.0, high=75.0, duration=20.0)
    bench.controller.start()
    while bench.controller.progress < 0.5:
        pass_time(bench, 0.1)
    curves = bench.monitor.frf.curves()
    measured = curves.frequency[np.isfinite(curves.value[1])]
    assert measured[0] <= 51.0 and 58.0 < measured[-1] < 65.0
    assert (curves.frequency[0], curves.frequency[-1]) == (50.0, 75.0)


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_state_follows_the_test(bench):
    states = [bench.state]
    set_controls(bench, level=5.0, low=50.0, high=75.0, duration=20.0)
    for recorded in (False, True):
        bench.recordings.enabled = recorded
        bench.controller.start()
        states.append(bench.state)
        while not bench.controller.progress:
            pass_time(bench, 0.1)
        complete_jobs(bench)
        pass_time(bench, 2.0)
        states.append(bench.state)
        assert 5.0 < bench.controller.remaining < 25.0
        assert bench.controller.force == pytest.approx(5.0, rel=0.1)
        bench.controller.stop()
        while bench.controller.running:
            pass_time(bench, 0.1)
        pass_time(bench, 0.1)
        complete_jobs(bench)
        states.append(bench.state)
    assert states == ["idle", "settling", "measuring", "aborted", "settling", "recording", "aborted"]


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_key_gives_a_single_hit(bench):
    set_controls(bench, level=100.0, hits=4, interval=2.0)
    bench.controller.start(single_impact=True)
    pass_time(bench, 4.0)
    assert len(bench.monitor.detector.impacts) == 1 and bench.controller.settings.hits == 4


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_single_hits_of_equal_settings_are_averaged(bench):
    set_controls(bench, level=100.0, hits=4, interval=2.0)
    averages, tests = [], []
    for level in (100.0, 100.0, 90.0):
        set_controls(bench, level=level)
        bench.controller.start(single_impact=True)
        pass_time(bench, 4.0)
        averages.append(bench.monitor.frf.curves().averages)
        tests.append(bench.controller.tests)
    assert averages == [1, 2, 1] and tests == [1, 1, 2]
    # The settings of one impact do not describe the average, nor does its end complete the test.
    assert bench.controller.details == "" and bench.controller.message == "impact 1 completed"


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_impact_is_listed_before_its_window_ends(bench):
    set_controls(bench, level=1000.0, hits=1, interval=2.0)
    bench.controller.start()
    pass_time(bench, 1.5)
    ((number, peak, faults, _, is_complete, overloaded),) = Page(bench)._state()["hits"]
    assert (number, faults, is_complete, overloaded) == (1, ["clipped"], False, [2]) and peak > 400.0


@pytest.mark.parametrize("bench", ["sine"], indirect=True)
def test_theory_has_the_static_compliance(bench):
    values = bench.controller.theory(np.array([0.0]))
    # Both springs carry the force at body 1 only through the first.
    assert values[:, 0] == pytest.approx([1 / 839e3, 1 / 839e3])


@pytest.mark.parametrize("bench", ["sine"], indirect=True)
def test_clients_see_a_frequency_response(bench):
    with bench.chassis.changed:
        bench.chassis.tasks["generator"], bench.chassis.outputs["task"] = "task", None
        bench._follow_clients(None, None)
        assert bench.monitor.is_estimating and bench.monitor.frf is not None
        # Level and rate are those of a test, not of a client.
        assert bench.controller.target is None and bench.controller.details == ""
        assert bench.is_driven_by_clients and bench.message == "driven by NI client generator"
        del bench.chassis.tasks["generator"], bench.chassis.outputs["task"]
        bench._follow_clients(None, None)
    assert not bench.monitor.is_estimating
    assert not bench.is_driven_by_clients and bench.message == "response to the drive of NI clients"


@pytest.mark.parametrize("bench", ["sine"], indirect=True)
def test_clients_leave_message_of_aborted_test(bench):
    bench.controller._on_end("a client has taken the output")
    with bench.chassis.changed:
        bench.chassis.tasks["generator"], bench.chassis.outputs["task"] = "task", None
        bench._follow_clients(None, None)
        during = bench.message
        del bench.chassis.tasks["generator"], bench.chassis.outputs["task"]
        bench._follow_clients(None, None)
    assert (during, bench.message) == (
        "driven by NI client generator", "test ended: a client has taken the output"
    )  # fmt: skip


def test_live_peak_next_to_a_gap_has_no_damping():
    f = np.linspace(1.0, 20.0, 1901)
    response = 1.0 / (100.0 - f**2 + 2j * 0.01 * 10.0 * f)
    response[(f > 10.05) & (f < 10.5)] = np.nan
    (peak,) = live_peaks(f, response, np.zeros(f.size))
    assert peak.frequency == pytest.approx(10.0) and peak.damping is None


def test_maximum_without_phase_drop_is_no_peak():
    f = np.linspace(1.0, 20.0, 1901)
    bump = 0.1 + np.exp(-((f - 10.0) ** 2)) + 0j
    assert not live_peaks(f, bump, np.zeros(f.size))
    assert live_peaks(f, bump * np.exp(-2j * np.arctan(f - 10.0)), np.zeros(f.size))


def test_peak_of_one_channel_alone_is_no_mode():
    f = np.linspace(1.0, 20.0, 1901)
    mode = 1.0 / (100.0 - f**2 + 2j * 0.02 * 10.0 * f)
    other = np.full(f.size, 10.0 * np.abs(mode).max(), complex)
    for rest, count in [(0.5 * mode, 1), (other, 0)]:
        assert len(live_peaks(f, mode, np.zeros(f.size), np.array([mode, rest]))) == count


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_client_tones_are_single_lines_with_their_rms(bench):
    bench.controller.start_client_estimate()
    frf = bench.monitor.frf
    time = np.arange(8 * round(frf._rate)) / frf._rate
    tones = np.sin(2.0 * np.pi * 34.3 * time) + 0.5 * np.sin(2.0 * np.pi * 80.0 * time)
    readings = np.tile(tones, (len(bench.monitor.channels), 1))
    frf.add(readings, np.zeros(readings.shape, bool), (0.0, 400.0))
    curves = frf.curves()
    assert curves.frequency[np.isfinite(curves.value[0])].tolist() == [34.0, 80.0]
    # The weights correct the force for the response of its channel.
    weights = np.abs(frf._channel_weights[2, np.searchsorted(frf.frequency, [34.0, 80.0])])
    assert np.sqrt(2.0) * curves.force[np.isfinite(curves.force)] == pytest.approx([1.0, 0.5] * weights, rel=2e-3)


def test_damping_interval_contains_the_true_value():
    rng, rate, ratio, averages = np.random.default_rng(1), 256.0, 0.03, 8
    for _ in range(20):
        force = rng.standard_normal(round(200 * rate))
        f = np.fft.rfftfreq(force.size, 1.0 / rate)
        system = 1.0 / (34.0**2 - f**2 + 2j * ratio * 34.0 * f)
        motion = np.fft.irfft(system * np.fft.rfft(force)) + 2e-4 * rng.standard_normal(force.size)
        blocks = np.array([[x[k * 512 : k * 512 + 1024] for k in range(averages)] for x in (force, motion)])
        force, motion = np.fft.rfft(np.hanning(1024) * blocks, axis=2)
        cross, power = (motion * force.conj()).sum(axis=0), (abs(force) ** 2).sum(axis=0)
        coherence = abs(cross) ** 2 / power / (abs(motion) ** 2).sum(axis=0)
        count = np.full(power.size, averages)
        curves = LiveCurves(
            ["a"], np.fft.rfftfreq(1024, 1.0 / rate), (cross / power)[None], coherence[None],
            np.zeros((1, power.size), int), np.ones(power.size), count,
        )  # fmt: skip
        (peak,) = largest_peaks(curves, 1)
        assert abs(peak.damping - ratio) < peak.expanded < 0.5 * ratio


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_exact_response_has_full_coherence(bench):
    frf = LiveFrf(bench.chassis.bench.scene, bench.monitor.channels, 1024.0, 1.0, (5.0, 400.0))
    force = np.random.default_rng(1).standard_normal(512 * 9)
    readings = np.array([0.3 * force, 0.7 * force, force])
    frf.add(readings, np.zeros(readings.shape, bool), (5.0, 400.0))
    coherence = frf.curves().coherence
    assert coherence.max() == 1.0 and coherence.min() > 1.0 - 1e-9


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
@pytest.mark.parametrize("averages", [2, 4, 30])
def test_noise_has_few_live_peaks(bench, averages):
    frf = LiveFrf(bench.chassis.bench.scene, bench.monitor.channels, 1024.0, 1.0, (5.0, 400.0))
    readings = np.random.default_rng(1).standard_normal((3, 512 * (averages + 1)))
    # Half of the motion is due to the force.
    readings[:2] += readings[2]
    frf.add(readings, np.zeros(readings.shape, bool), (5.0, 400.0))
    curves = frf.curves()
    # A flat acceleration: the displacement falls with the square of the frequency.
    flat = replace(curves, value=curves.value * curves.frequency**2)
    assert curves.averages == averages and len(largest_peaks(flat, 100)) <= 2


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
@pytest.mark.parametrize(("ratio", "lowest"), [(2e-3, (15.0, 55.0)), (5e-2, (1.0, 5.0))])
def test_truncated_decay_hides_low_frequencies(bench, ratio, lowest):
    rate, rest = 1024.0, 2.0
    time = np.arange(round(rest * rate)) / rate
    # Acceleration after an impulse at 0.1 s, of a single mode at 61.83 Hz with the given damping ratio.
    omega, since = 2.0 * np.pi * 61.83, np.maximum(time - 0.1, 0.0)
    velocity = np.exp(-ratio * omega * since) * np.cos(omega * since) * (time >= 0.1)
    pulse = np.where(abs(time - 0.1) < 0.004, np.cos(np.pi * (time - 0.1) / 0.008), 0.0)
    motion = np.convolve(pulse, np.gradient(velocity, 1.0 / rate))[: time.size]
    frf = LiveFrf(bench.chassis.bench.scene, bench.monitor.channels, rate, rest, (2.0, 400.0))
    frf.add_impact(SimpleNamespace(readings=np.array([motion, motion, pulse]), accepted=True, overloaded=[]))
    curves = frf.curves()
    first = curves.frequency[np.isfinite(curves.value[0])][0]
    assert lowest[0] <= first <= lowest[1]


def test_peak_list_names_highest_determined_channel():
    f = np.linspace(1.0, 20.0, 1901)
    low, high = (1.0 / (f0**2 - f**2 + 2j * 0.01 * f0 * f) for f0 in (5.0, 12.0))
    values = np.array([low + 0.1 * high, 0.1 * low + high])
    curves = LiveCurves(
        ["a", "b"], f, values, np.ones(values.shape), np.zeros(values.shape, int), np.ones(f.size), np.full(f.size, 3)
    )
    assert [(peak.name, round(peak.frequency, 1)) for peak in largest_peaks(curves, 4)] == [("a", 5.0), ("b", 12.0)]
    curves.coherence[:, f > 10.0] = np.nan
    assert [peak.name for peak in largest_peaks(curves, 4)] == ["a"]
    # A small peak with a low coherence may be noise.
    curves.coherence[:, f > 10.0] = 0.5
    assert len(largest_peaks(curves, 4)) == 2
    curves.value[:, f > 10.0] *= 0.5
    assert len(largest_peaks(curves, 4)) == 1


def test_unrelated_signals_rarely_exceed_the_coherence_limit():
    rng, lines = np.random.default_rng(1), 20_000
    for averages in (2, 3, 5):
        force, motion = rng.standard_normal((2, averages, lines, 2)) @ [1.0, 1.0j]
        cross, powers = (motion * force.conj()).sum(axis=0), [(abs(each) ** 2).sum(axis=0) for each in (force, motion)]
        coherence = abs(cross) ** 2 / powers[0] / powers[1]
        count = np.full(lines, averages)
        curves = LiveCurves(["a"], count, cross[None], coherence[None], count[None], powers[0], count)
        assert np.mean(coherence > curves.coherence_limit) < 0.055
    assert np.isnan(replace(curves, count=np.array([1])).coherence_limit)


def test_peak_near_the_moving_tone_is_not_listed():
    f = np.linspace(1.0, 20.0, 1901)
    values = (1.0 / (100.0 - f**2 + 2j * 0.1 * f))[None]
    ones, count = np.ones(values.shape), np.full(f.size, 3)
    curves = LiveCurves(["a"], f, values, ones, np.zeros(values.shape, int), ones[0], count)
    assert [len(largest_peaks(curves, 4, tone)) for tone in (10.5, 11.0, None)] == [0, 1, 1]


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_only_accepted_hits_are_marked_and_averaged(bench):
    set_controls(bench, level=100.0, hits=4, interval=2.0)
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 7.5)
    hits = bench.monitor.detector.impacts
    assert [hit.faults for hit in hits] == [[], ["double impact"], []]
    assert bench.monitor.frf.curves().averages == 2
    hits[2].accepted = False
    assert bench.monitor.frf.curves().averages == 1
    # The spectrum of a pulse of 8 ms, a half sine, has its first zero at 1.5 / 8 ms.
    curves = bench.monitor.frf.curves()
    assert 150.0 < curves.frequency[np.isfinite(curves.value[0])][-1] < 1.5 / 8e-3
    pass_time(bench, 2.5)
    bench.close()
    with daq.open(bench.recordings.paths[0]) as recording:
        kinds = [(each.kind, each.fields.get("reason")) for each in recording.markers]
        assert kinds == [("hit", None), ("rejected", "double impact"), ("rejected", "operator"), ("hit", None)]
        frf = analysis.frfs(recording)["arm"]
        band = (frf.frequency > 50) & (frf.frequency < 75)
        assert frf.frequency[band][np.argmax(abs(frf.value[band]))] == pytest.approx(62.0, abs=0.5)


@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_overload_is_latched_until_cleared(bench):
    set_controls(bench, level=1000.0, hits=2, interval=2.0)
    bench.controller.start()
    pass_time(bench, 4.0)
    ((row, (first, last, reading)),) = bench.monitor.overloads.items()
    # The second impact clips too.
    assert row == 2 and first < 1.0 < last and reading == pytest.approx(5.0 / 11e-3, rel=1e-6)
    bench.monitor.overloads.clear()
    pass_time(bench, 1.0)
    assert not bench.monitor.overloads


@pytest.mark.parametrize(("rows", "relations"), [([1], ["", "≥"]), ([2], ["≤", "≤"]), ([1, 2], ["≤", "?"])])
@pytest.mark.parametrize("bench", ["hammer"], indirect=True)
def test_clipped_hit_bounds_the_response(bench, rows, relations):
    set_controls(bench, level=1000.0, hits=1, interval=2.0)
    bench.controller.start()
    pass_time(bench, 4.0)
    (hit,), frf = bench.monitor.detector.impacts, bench.monitor.frf
    assert hit.faults == ["clipped"] and frf.curves() is None
    hit.overloaded, hit.accepted = rows, True
    assert [RELATIONS[k] for k in frf.curves().relation[:, 0]] == relations


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_live_force_of_sweep_is_its_level(bench):
    set_controls(bench, level=5.0, low=40.0, high=50.0, duration=4.0)
    bench.controller.start()
    while bench.controller.running:
        pass_time(bench, 0.5)
    force = bench.controller.level_per_rms * bench.monitor.frf.curves().force
    assert np.nanmin(force) > 4.8 and np.nanmax(force) < 5.2
    assert bench.controller.details == "upward at 4.83 oct/min"


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_outputs_are_zero_after_a_test(bench):
    set_controls(bench, level=5.0, low=40.0, high=50.0, duration=4.0)
    bench.controller.start()
    pass_time(bench, 2.0)
    assert bench.controller.running and not bench.outputs()[0].startswith("output 1: 0 V")
    while bench.controller.running:
        pass_time(bench, 0.25)
    assert bench.monitor.drive_levels()[0][0] > 1.0
    assert bench.outputs() == ["output 1: 0 V"]
    bench.monitor.drive_history.add(bench.monitor.drive_history.stop, np.ones((1, 1)))
    assert bench.outputs()[0].endswith(" V (held)")


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_clipped_block_bounds_its_lines(bench):
    # At 62 Hz the arm exceeds 50 g.
    set_controls(bench, level=120.0, low=50.0, high=75.0, duration=12.0)
    bench.controller.start()
    while bench.controller.running:
        pass_time(bench, 0.5)
    curves = bench.monitor.frf.curves()
    clipped = curves.frequency[curves.relation[1] == RELATIONS.index("≥")]
    assert clipped[0] > 55.0 and clipped[-1] < 70.0
    (peak,) = largest_peaks(curves, 1)
    assert (peak.damping, peak.relation) == (None, "≥") and peak.frequency == pytest.approx(62.0, abs=1.0)
    pass_time(bench, 1.0)
    assert bench.monitor.overloads and not bench.monitor.overloaded_rows()


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_each_test_has_its_own_recording(bench):
    set_controls(bench, level=5.0, low=50.0, high=75.0, duration=2.0)
    bench.recordings.enabled = True
    for _ in range(2):
        bench.controller.start()
        pass_time(bench, 5.0)
    bench.close()
    assert [path.name for path in bench.recordings.paths] == ["test.mcap", "test-2.mcap"]
    for path in bench.recordings.paths:
        with daq.open(path) as recording:
            assert any(each.kind == "measure" for each in recording.markers)


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_unusable_recording_folder_is_reported(bench, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    bench.recordings._path = tmp_path / "file" / "test.mcap"
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 0.5)
    bench.close()
    assert "a file has this name" in bench.recordings.problem
    assert not bench.recordings.enabled


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_wrong_settings_are_reported(bench):
    set_controls(bench, low=50.0, high=50.0)
    bench.controller.start()
    assert not bench.controller.running
    assert "the same as `from`" in bench.controller.message


@pytest.mark.parametrize("bench", ["sine"], indirect=True)
@pytest.mark.parametrize("name", ["level", "frequency"])
def test_empty_field_is_reported(bench, name):
    set_controls(bench, **{name: None})
    bench.controller.start()
    assert not bench.controller.running and bench.controller.message == f"{name}: the field is empty. Enter a number."
    set_controls(bench, level=1.0, frequency=40.0)
    bench.controller.start()
    set_controls(bench, **{name: None})
    bench.controller.apply_settings()
    assert bench.controller.running and bench.controller.message == f"{name}: the field is empty. Enter a number."


def test_client_and_page_share_the_output(tmp_path):
    with connect(make_scene("sine"), clock="real") as client:
        live_bench = LiveBench(client.chassis, "", tmp_path / "client.mcap", False)
        with nidaqmx.Task("mine", grpc_options=client) as task:
            task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
            live_bench.recordings.enabled = True
            task.control(TaskMode.TASK_RESERVE)
            assert live_bench.clients(9)[0].startswith("mine")
            live_bench.controller.start()
            assert "mine" in live_bench.controller.message and not live_bench.controller.running
        live_bench.controller.start()
        assert live_bench.controller.running
        assert live_bench.clients(9) == []
        live_bench.close()


def start_recording(bench):
    """Start a test that is recorded, and wait until a group of samples is on the disk."""
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 0.7)
    complete_jobs(bench)


def complete_jobs(bench):
    """Wait until the recorder has written all waiting blocks."""
    done = threading.Event()
    bench.recordings._jobs.put(done.set)
    assert done.wait(60.0)


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_full_disk_completes_the_recording(bench, monkeypatch):
    start_recording(bench)
    monkeypatch.setattr(CommittedFile, "free", lambda _: RESERVE)
    pass_time(bench, 1.5)
    complete_jobs(bench)
    assert not bench.recordings.running and "disk is full" in bench.recordings.problem
    (path,) = bench.recordings.paths
    with daq.open(path) as recording:
        assert (recording.status, recording.samples / recording.rate) == ("failed", 0.5)
    with pytest.raises(RunError, match="disk is full"):
        bench.chassis.raise_problems()


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_moved_recording_continues(bench, tmp_path):
    start_recording(bench)
    bench.recordings.paths[0].rename(tmp_path / "moved.mcap")
    pass_time(bench, 1.0)
    bench.close()
    with daq.open(tmp_path / "moved.mcap") as recording:
        assert recording.samples > recording.rate
    assert "was moved" in bench.recordings.problem


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_unexpected_error_ends_the_recording(bench, monkeypatch):
    start_recording(bench)
    monkeypatch.setattr(MarkedRecording, "write", lambda *_: 1 // 0)
    pass_time(bench, 0.5)
    complete_jobs(bench)
    assert "ZeroDivisionError" in bench.recordings.problem
    assert not bench.recordings.running and not bench.recordings.enabled


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_stalled_disk_ends_the_recording(bench, monkeypatch):
    released = threading.Event()
    bench.recordings._jobs.put(released.wait)
    monkeypatch.setattr("daq.extras.bench_page.recordings._MAX_WAITING_JOBS", 3)
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 1.0)
    released.set()
    bench.close()
    assert "the disk is too slow" in bench.recordings.problem and not bench.recordings.enabled
    with daq.open(bench.recordings.paths[0]) as recording:
        recording.check()


@pytest.mark.parametrize("bench", ["sweep"], indirect=True)
def test_failed_display_is_reported(bench, monkeypatch):
    monkeypatch.setattr(bench.monitor, "_process", lambda *_: 1 // 0)
    pass_time(bench, 0.5)
    assert [problem for problem in bench.chassis.problems if "the display of the page has ended" in problem]


@pytest.mark.parametrize(
    ("name", "element"),
    [
        ("stop", "joint_1"),
        ("friction-joint", "body_3-joint_1"),
        ("friction-damper", "body_3-damper"),
        ("tuned-mass-damper", "body_3-damper"),
        ("impact-damper-on-spring", "body_3-damper"),
    ],
)
def test_each_contact_law_runs_and_is_drawn(name, element, tmp_path):
    scene = rig.load(name)
    bench = LiveBench(connect_scene(scene, "manual"), "", tmp_path / "test.mcap", False)
    bench.controller.settings.kind = "sine"
    bench.recordings.enabled = True
    bench.controller.start()
    pass_time(bench, 1.0)
    bench.controller.stop()
    pass_time(bench, 3.0)
    assert not bench.controller.running and not bench.chassis.problems
    motion, drawing = bench.monitor.motion(), RigDrawing(scene)
    drawing.frames(motion)
    assert f'id="rig-{element}"' in drawing.svg and np.ptp(motion.displacement) > 0.0
    bench.close()
    with daq.open(bench.recordings.paths[0]) as recording:
        recording.check()


def test_springs_do_not_cross_the_label_of_the_table():
    scene = rig.load("fig8-three-dampers")
    drawing = RigDrawing(scene)
    drawing.frames(RigMotion(np.zeros((scene.structure.bodies, 1)), np.zeros((len(scene.tables), 1))))
    (label,) = re.findall(r'<text x="(\d+)"[^>]*>table<', drawing.svg)
    springs = re.findall(r'id="rig-spring_1">(.*?)</g>', drawing.svg)
    assert int(label) > max(float(x) for x in re.findall(r"([\d.]+),", springs[0]))


def test_port_in_use_is_reported_before_the_start():
    pytest.importorskip("starlette", reason="the extra 'bench' is not installed")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with (
            pytest.raises(SceneError, match=f"cannot listen at 127.0.0.1:{port}"),
            _serve_page(None, "127.0.0.1", port),
        ):
            pass


def test_browser_process_does_not_show_the_token(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    _open_browser("http://127.0.0.1:8031/?token=secret", tmp_path)
    (uri,) = opened
    assert "secret" not in uri and "token=secret" in Path(uri.removeprefix("file://")).read_text()


@pytest.fixture
def live(bench):
    """Function that opens the web socket of the page."""
    pytest.importorskip("starlette", reason="the extra 'bench' is not installed")
    client = pytest.importorskip("websockets.sync.client", reason="the extra 'bench' is not installed")
    with _serve_page(bench, "127.0.0.1", 0) as address:
        yield lambda: client.connect(address.replace("http", "ws").replace("/?", "/live?"), max_size=None)


@pytest.mark.parametrize("bench", ["shaker"], indirect=True)
@pytest.mark.parametrize("command", ['["level", NaN]', '["span", NaN]', '["level", 1e999]', '["span", "x"]'])
def test_page_continues_after_invalid_number(live, command):
    with live() as socket:
        socket.recv(timeout=60.0)
        socket.send(command)
        # The command may be obeyed after the next message.
        for _ in range(5):
            message = socket.recv(timeout=60.0)
            # JSON has no NaN: browsers would not read the message.
            assert json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")], parse_constant=pytest.fail)


@pytest.mark.parametrize("bench", ["shaker"], indirect=True)
def test_oversize_command_is_rejected(live):
    from websockets.exceptions import ConnectionClosedError

    with live() as socket:
        socket.send(f"[{'1,' * 100_000}1]")
        with pytest.raises(ConnectionClosedError, match="1009"):
            while True:
                socket.recv(timeout=60.0)
