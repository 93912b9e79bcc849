"""Detection of damper impacts: times, walls and velocity jumps, compared with known impacts."""

import numpy as np
import pytest

import daq
import rig
from analysis.core.damper_motion.impact_detection import detect_impacts
from analysis.core.damper_motion.landing_pulse import landing_pulse
from analysis.core.damper_motion.matching_pursuit import DETECTION_MARGIN_SIGMAS, DETECTION_SIGMAS
from analysis.core.responses.errors.systematic import stated_tolerance
from daq.core.recording.markers import Marker
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError
from tests.analysis.responses import synthetic
from tests.gauntlet.checks.impacts import check, detectable, score
from tests.gauntlet.finite_contact import TONE_FINITE_CONTACT, draw_finite_contact
from tests.gauntlet.instant_contact import TONE, draw_instant_contact
from tests.gauntlet.result import Case

RATE = synthetic.RATE


def record_jumps(path, quantity="displacement", noise=2e-8, count=300):
    """Record a body that vibrates at 40 Hz, with velocity jumps of 3 to 20 mm/s at random times.

    Returns the path, the times in s and the jumps in m/s. The acceleration is averaged over each sample interval.
    """
    random = np.random.default_rng(1)
    t = np.arange(int(30 * RATE)) / RATE
    times = 0.05 + np.cumsum(random.uniform(0.02, 0.15, count))
    times = times[times < 29.9]
    jumps = random.choice([-1.0, 1.0], times.size) * random.uniform(3e-3, 2e-2, times.size)
    displacement = 2e-4 * np.sin(2 * np.pi * 40.0 * t)
    velocity = 2e-4 * 2 * np.pi * 40.0 * np.cos(2 * np.pi * 40.0 * t)
    for time, jump in zip(times, jumps, strict=True):
        displacement += jump * np.maximum(t - time, 0.0)
        velocity += jump * (t >= time)
    samples = displacement if quantity == "displacement" else np.diff(velocity, prepend=velocity[0]) * RATE
    infos = [ChannelInfo("body1", "body 1", quantity, 1.0, RATE, average=quantity == "acceleration")]
    noise_level = noise if quantity == "displacement" else noise * RATE**2
    samples = samples + noise_level * random.standard_normal(samples.size)
    return synthetic.write(path, synthetic.scene(), infos, samples[None], []), times, jumps


@pytest.mark.parametrize("quantity", ["displacement", "acceleration"])
def test_known_impacts_have_correct_times_and_sizes(tmp_path, quantity):
    path, times, jumps = record_jumps(tmp_path / "a.mcap", quantity)
    with daq.open(path) as rec:
        detected = detect_impacts(rec, "body1")
    detectable_jumps = abs(jumps) > detected.detection_limit
    f1, _, matched = score(detected.time, times, 2.0 / RATE)
    assert f1 > 0.98 and matched[detectable_jumps].mean() > 0.98
    nearest = np.array([np.argmin(abs(times - time)) for time in detected.time])
    matched_times = abs(detected.time - times[nearest]) < 2.0 / RATE
    assert np.median(abs(detected.jump - jumps[nearest])[matched_times]) < 5e-4
    walls = np.where(jumps[nearest] < 0, "floor", "ceiling")
    assert np.mean((detected.wall == walls)[matched_times]) > 0.98


def test_point_samples_of_acceleration_are_rejected(tmp_path):
    infos = [ChannelInfo("body1", "body 1", "acceleration", 1.0, RATE)]
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, np.zeros((1, 4000)), [])
    with daq.open(path) as rec, pytest.raises(RecordingError, match="at instants"):
        detect_impacts(rec, "body1")


SENSOR = {"sensitivity": 0.0102, "noise": 1.96e-4, "resonance": 30e3, "low_cutoff": 0.5}
INTEGRATORS = {
    "acceleration": {},
    "velocity": {"integrator": {"order": 1, "corner": 1.0, "gain": 10.0}},
    "displacement": {"integrator": {"order": 2, "corner": 1.0, "gain": 1000.0}},
}


def true_impacts(rec, damper):
    """Return the true times in s and velocity jumps in m/s of a damper with a tenth of the mass of its body."""
    events = rec.events
    impact_events = events[(events["kind"] != "separation") & (events["damper"] == damper)]
    return impact_events["time"], 0.1 / 1.1 * impact_events["speed"]


def f1_score(matched, true_matched, expected):
    """Return the F1 score of detected impacts, if only the expected true impacts count as missed; 1 without impacts."""
    matches, missed = np.sum(true_matched & expected), np.sum(~true_matched & expected)
    total = 2 * matches + missed + np.sum(~matched)
    return 2 * matches / total if total else 1.0


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("frequency", "quantity"),
    [(34.7, "acceleration"), (34.7, "displacement"), (49.0, "velocity"), (49.0, "displacement")],
)
def test_three_dampers_at_resonance_are_detected(tmp_path, quantity, frequency):
    chain = {"accelerometer": SENSOR} | INTEGRATORS[quantity]
    positions = ("body 1", "body 2", "body 3", "table")
    scene = rig.load("fig8-three-dampers").replace(
        shaker={"kind": "table", "body": 1, "spring": 6600.0},
        test={"kind": "sine", "frequency": frequency, "force": 2.6, "duration": 1.5},
        channels=[{"name": at.replace(" ", ""), "at": at, **chain} for at in positions],
        recording={"truth": True, "display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        assert rec.channels["body1"].quantity == quantity
        for body in (1, 2, 3):
            start = rec.samples - int(3 * rec.rate)
            detected = detect_impacts(rec, f"body{body}", start)
            times, jumps = true_impacts(rec, body)
            inner = (times > start / rec.rate + 0.05) & (times < rec.samples / rec.rate - 0.05)
            expected = inner & (jumps > detected.detection_limit)
            _, matched, true_matched = score(detected.time, times, 2.0 / rec.rate)
            assert f1_score(matched, true_matched, expected) >= 0.98
            assert detected.detection_limit < 3.5e-3


@pytest.mark.parametrize("quantity", ["acceleration", "displacement"])
def test_delta_sigma_filter_keeps_times_and_sizes(tmp_path, quantity):
    chain = {"accelerometer": SENSOR} | INTEGRATORS[quantity]
    scene = rig.load("fig8-three-dampers").replace(
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 49.0, "force": 2.6, "duration": 1.5},
        channels=[{"name": "body1", "at": "body 1", **chain}, {"name": "force", "at": "shaker"}],
        converter={"rate": 5120.0, "filter": "delta_sigma"},
        recording={"truth": True, "display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        start = rec.samples // 2
        detected = detect_impacts(rec, "body1", start)
        times, jumps = true_impacts(rec, 1)
        inner = (times > start / rec.rate + 0.05) & (times < rec.samples / rec.rate - 0.05)
        expected = inner & (jumps > detected.detection_limit)
        _, matched, true_matched = score(detected.time, times, 2.0 / rec.rate)
    assert np.sum(true_matched & expected) > 25 and f1_score(matched, true_matched, expected) >= 0.98
    nearest = np.array([np.argmin(abs(detected.time - time)) for time in times[true_matched & expected]])
    assert np.median(-detected.jump[nearest] / jumps[true_matched & expected]) == pytest.approx(1.0, abs=0.005)
    assert np.mean(abs(-detected.jump[nearest] / jumps[true_matched & expected] - 1.0) < 0.02) > 0.95


def test_integrated_channels_give_body_acceleration(tmp_path):
    high_pass = {"integrator": {"order": 2, "corner": 4.0, "gain": 1000.0}}
    scene = rig.load("fig8-three-dampers").replace(
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 34.7, "force": 2.6, "duration": 1.0},
        channels=[
            {"name": "direct", "at": "body 3", "accelerometer": SENSOR},
            {"name": "integrated", "at": "body 3", "accelerometer": SENSOR, **high_pass},
            {"name": "force", "at": "shaker"},
        ],
        recording={"display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        direct, integrated = (detect_impacts(rec, name, rec.samples // 2) for name in ("direct", "integrated"))
    _, direct_matched, integrated_matched = score(direct.time, integrated.time, 1.0 / RATE)
    assert direct_matched.sum() > 10
    difference = direct.acceleration[direct_matched] - integrated.acceleration[integrated_matched]
    assert np.nanmedian(abs(difference)) < 0.03 * np.nanmax(abs(direct.acceleration))


def test_detection_limit_is_proportional_to_noise(tmp_path):
    thresholds = []
    for noise in (2e-3, 2e-2):
        scene = rig.load("fig8-three-dampers").replace(
            shaker={"kind": "force", "body": 1},
            test={"kind": "sine", "frequency": 34.7, "force": 2.6, "duration": 1.0},
            channels=[
                {"name": "body1", "at": "body 1", "accelerometer": {"sensitivity": 0.01, "noise": noise}},
                {"name": "force", "at": "shaker"},
            ],
            recording={"display": False},
        )
        with daq.open(daq.record(scene, tmp_path / f"{noise}.mcap")) as rec:
            thresholds.append(detect_impacts(rec, "body1").detection_limit)
    assert thresholds[1] / thresholds[0] == pytest.approx(10.0, rel=0.15)


def test_noise_alone_gives_no_impact(tmp_path):
    thresholds = []
    for noise in (1e-8, 1e-7):
        path, _, _ = record_jumps(tmp_path / "a.mcap", noise=noise, count=0)
        with daq.open(path) as rec:
            detected = detect_impacts(rec, "body1")
        assert detected.time.size == 0
        assert detected.detection_limit == pytest.approx((DETECTION_SIGMAS + DETECTION_MARGIN_SIGMAS) * detected.noise)
        thresholds.append(detected.detection_limit)
    assert 5.0 < thresholds[1] / thresholds[0] < 12.0


def test_slow_motion_gives_no_impact(tmp_path):
    # Within the length of the filter, the curvature of the motion is about twenty times the noise.
    t = np.arange(int(5 * RATE)) / RATE
    samples = 7.0 * np.sin(2 * np.pi * 0.003 * RATE * t) + 1e-3 * np.random.default_rng(3).standard_normal(t.size)
    delta_sigma = {"rate": RATE, "delay": 38.0, "cutoff": 0.5, "beta": 11.0}
    infos = [ChannelInfo("body1", "body 1", "acceleration", 1.0, RATE, filter=delta_sigma)]
    with daq.open(synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, samples[None], [])) as rec:
        detected = detect_impacts(rec, "body1")
    assert detected.time.size == 0 and not len(detected.unsearched)


def record_zeros(path, quantity, count):
    """Record samples that are zero except for `count` samples."""
    samples = np.zeros(int(RATE))
    samples[1 : count + 1] = 1e-6
    infos = [ChannelInfo("body1", "body 1", quantity, 1.0, RATE, average=quantity == "acceleration")]
    return synthetic.write(path, synthetic.scene(), infos, samples[None], [])


@pytest.mark.parametrize("quantity", ["displacement", "acceleration"])
def test_constant_reading_gives_no_impact(tmp_path, quantity):
    # The motion is below the resolution of the converter.
    with daq.open(record_zeros(tmp_path / "a.mcap", quantity, count=3)) as rec:
        assert not detect_impacts(rec, "body1").time.size


def test_empty_channel_is_reported(tmp_path):
    with (
        daq.open(record_zeros(tmp_path / "a.mcap", "displacement", count=0)) as rec,
        pytest.raises(RecordingError, match="body1 reads zero throughout"),
    ):
        detect_impacts(rec, "body1")


def test_too_few_samples_are_reported(tmp_path):
    path, _, _ = record_jumps(tmp_path / "a.mcap", count=0)
    with daq.open(path) as rec, pytest.raises(RecordingError, match="at least 96 samples"):
        detect_impacts(rec, "body1", 0, 50)


def record_tone(path, chain, converter, dampers, frequency=49.0):
    """Record a tone of this frequency in Hz and 3.3 N, with these dampers in body 2, and the truth."""
    scene = rig.load("fig8-no-damper").replace(
        dampers=[{"body": 2, "mass_ratio": 0.06, **damper} for damper in dampers],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": frequency, "force": 3.3, "duration": 1.0},
        channels=[{"name": "body2", "at": "body 2", **chain}, {"name": "force", "at": "shaker"}],
        converter=converter,
        recording={"truth": True, "display": False},
    )
    return daq.record(scene, path)


COMMERCIAL_CHAIN = {"accelerometer": {"preset": "PCB 352C33"}}, {"preset": "NI 9234", "rate": 51200.0}
INTEGRATED_CHAIN = {"accelerometer": SENSOR, **INTEGRATORS["velocity"]}, {"rate": 12800.0}


@pytest.mark.parametrize(
    ("chain", "converter", "duration", "restitution", "frequency"),
    [
        ({}, {"rate": 5120.0}, 2e-3, 0.0, 49.0),
        ({}, {"rate": 5120.0}, 6e-3, 0.0, 34.5),
        (*COMMERCIAL_CHAIN, 2e-3, 0.4, 49.0),
        (*COMMERCIAL_CHAIN, 0.7e-3, 0.0, 49.0),
        (*INTEGRATED_CHAIN, 2e-3, 0.0, 49.0),
        (*INTEGRATED_CHAIN, 2e-3, 0.4, 34.5),
    ],
)
def test_finite_duration_impacts_lie_within_errors(tmp_path, chain, converter, duration, restitution, frequency):
    damper = {"clearance": 0.98e-3, "restitution": restitution, "contact": {"duration": duration}}
    with daq.open(record_tone(tmp_path / "a.mcap", chain, converter, [damper], frequency)) as rec:
        [window] = [marker for marker in rec.markers if marker.kind == "measure"]
        detected = detect_impacts(rec, "body2", window.first_sample, window.stop)
        touches = rec.events[rec.events["kind"] == "touch"]
        gap = rec.truth("gap")[0, (touches["time"] * rec.rate).astype(int)]
        sensitivity_tolerance = stated_tolerance(rec.channels["body2"])
        pulse_restitution = landing_pulse(rec.scene, "body 2", rec.rate).restitution
    assert detected.contact_duration == pytest.approx(duration)
    # Below half the clearance the damper touches the floor. The damper has 6 % of the mass of its body.
    jump = np.where(gap < 0.49e-3, -1.0, 1.0) * touches["speed"] * 0.06 / 1.06 * (1.0 + pulse_restitution)
    _, matched, true_matched = score(detected.time, touches["time"], 0.25 * duration)
    inner = (touches["time"] > detected.time[0] - 1e-3) & (touches["time"] < detected.time[-1] + 1e-3)
    expected = inner & detectable(touches["time"], jump, detected)
    begin, end = detected.unsearched.T - 1e-3 * np.array([[1.0], [-1.0]])
    expected &= ~((touches["time"][:, None] > begin) & (touches["time"][:, None] < end)).any(axis=1)
    assert matched.all() and matched.sum() > 15 and true_matched[expected].all()
    assert np.all(np.sign(detected.jump) == np.sign(jump[true_matched]))
    assert np.all(abs(detected.time - touches["time"][true_matched]) < 4.0 * detected.time_std)
    assert np.median(detected.time_std) < 0.1 * duration
    assert np.all(
        abs(detected.jump - jump[true_matched]) < 4.0 * detected.jump_std + sensitivity_tolerance * abs(detected.jump)
    )


def test_too_coarse_samples_are_reported(tmp_path):
    damper, converter = {"clearance": np.inf, "contact": {"duration": 2e-3}}, {"sampling": "point"}
    with (
        daq.open(record_tone(tmp_path / "a.mcap", {}, {"rate": 5120.0, **converter}, [damper])) as rec,
        pytest.raises(RecordingError, match="at instants"),
    ):
        detect_impacts(rec, "body2")
    with daq.open(record_tone(tmp_path / "b.mcap", {}, {"rate": 51200.0, **converter}, [damper])) as rec:
        assert detect_impacts(rec, "body2", rec.samples // 2).time.size > 10


def test_equal_dampers_in_body_are_both_detected(tmp_path):
    contact = {"restitution": 0.0, "contact": {"duration": 1e-3}}
    dampers = [{"clearance": np.inf, **contact}, {"clearance": 0.4e-3, **contact}]
    with daq.open(record_tone(tmp_path / "a.mcap", {}, {"rate": 51200.0}, dampers)) as rec:
        detected = detect_impacts(rec, "body2", rec.samples // 2)
        touches = rec.events[rec.events["kind"] == "touch"]
    f1, matched, _ = score(detected.time, touches["time"][touches["time"] > detected.time[0] - 1e-3], 2e-4)
    assert matched.all() and f1 > 0.9


def test_different_contacts_in_body_are_reported(tmp_path):
    floor, ceiling = {"duration": 2e-3}, {"duration": 4e-3}
    dampers = [{"clearance": 0.98e-3, "contact": {"floor": floor, "ceiling": ceiling}}]
    with (
        daq.open(record_tone(tmp_path / "a.mcap", {}, {"rate": 5120.0}, dampers)) as rec,
        pytest.raises(
            RecordingError, match="body 2: contact durations or restitutions of floor, ceiling or dampers differ"
        ),
    ):
        detect_impacts(rec, "body2")


def test_long_contact_gives_no_false_impact(tmp_path):
    damper = {"clearance": np.inf, "restitution": 0.0, "contact": {"duration": 12e-3}}
    with daq.open(record_tone(tmp_path / "a.mcap", {}, {"rate": 5120.0}, [damper])) as rec:
        detected = detect_impacts(rec, "body2", rec.samples // 2)
        touches = rec.events[rec.events["kind"] == "touch"]["time"]
    assert score(detected.time, touches, 3e-3)[1].all()


def test_every_time_is_matched_once():
    f1, matched, true_matched = score(np.array([1.0, 1.01, 2.0]), np.array([1.0, 2.5]), 0.1)
    assert matched.tolist() == [True, False, False] and true_matched.tolist() == [True, False]
    assert f1 == pytest.approx(2 / 5)


def test_overloaded_channel_gives_no_impact(tmp_path):
    scene = rig.load("fig9", {"test": {"kind": "sine", "frequency": "49 Hz", "force": "3.3 N", "duration": "1 s"}})
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        without_overload = detect_impacts(rec, "body2")
        end = int(0.2 * rec.samples)
        rec.markers.append(Marker("overload", 0, end, {"channel": "body2"}))
        with_overload = detect_impacts(rec, "body2")
        rec.markers.append(Marker("overload", 0, int(0.7 * rec.samples), {"channel": "body2"}))
        with pytest.raises(RecordingError, match="lost or overloaded"):
            detect_impacts(rec, "body2")
    assert without_overload.unsearched.shape == (0, 2)
    assert with_overload.unsearched[0, 0] == 0.0 and with_overload.unsearched[0, 1] > end / rec.rate
    assert not ((with_overload.time > 0.0) & (with_overload.time < end / rec.rate)).any()


# Scenes of the gauntlet: a velocity channel records several rebounds in each period; each ceiling impact is followed by
# a floor impact before the fitted window ends.
@pytest.mark.parametrize(
    ("draw", "seed", "number", "kind", "min_points"),
    [(draw_instant_contact, 600101, 69, TONE, 100), (draw_finite_contact, 911, 13, TONE_FINITE_CONTACT, 70)],
    ids=["separate rebounds", "overlapping finite-duration impacts"],
)
def test_close_impacts_are_detected(tmp_path, draw, seed, number, kind, min_points):
    scene = draw(seed, number, kind)
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [result] = check(Case(scene, rec, []), kind)
    assert result.points > min_points
    assert result.inside == result.points
