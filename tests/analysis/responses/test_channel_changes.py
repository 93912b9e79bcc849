"""Channels that change their gain, die or are late are named; intact channels and structures are not."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import analysis
import daq
from analysis.core.responses.checks import channel_changes, tone_steps
from analysis.core.responses.checks.failed_channels import failed_channels
from analysis.core.responses.checks.gain_steps import describe_step, step_warnings
from rig.core.results.response import Response, stack
from tests.analysis.responses import synthetic
from tests.peak_memory import peak_memory

SECONDS = 40.0


@pytest.fixture(scope="module")
def random_test(tmp_path_factory):
    force = synthetic.band_noise(SECONDS, 5.0, 60.0)
    marks = [("measure", 0, round(SECONDS * synthetic.RATE) - 1, {"from": 5.0, "to": 60.0})]
    test = f"{{kind: random, from: 5 Hz, to: 60 Hz, duration: {SECONDS} s, force: 1 N}}"
    return synthetic.record_response(tmp_path_factory.mktemp("random") / "a.mcap", force, test, marks, noise=1e-3)


@pytest.fixture(scope="module")
def stepped_sine(tmp_path_factory):
    frequencies = np.geomspace(8.0, 60.0, 60)
    infos = synthetic.channels()
    infos[-1] = replace(infos[-1], name="force", at="shaker", quantity="force")
    return synthetic.stepped_sine(tmp_path_factory.mktemp("stepped") / "a.mcap", frequencies, infos=infos, noise=1e-8)


@pytest.fixture(scope="module")
def swept_sine(tmp_path_factory):
    return synthetic.swept_sine(tmp_path_factory.mktemp("swept") / "a.mcap", 8.0, 60.0, SECONDS, noise=1e-4)


@pytest.fixture(scope="module")
def impulses(tmp_path_factory):
    return synthetic.impulses(tmp_path_factory.mktemp("impulses") / "a.mcap", hits=8, noise=0.1)


def multisine(path, periods):
    """Record these periods of 2 s of a multisine, after eight unmeasured periods."""
    period = 2 * round(synthetic.RATE)
    fields = {"realisation": 1, "period": period, "periods": periods, "lines": [16, 120], "level": 1.0, "settled": True}
    test = f"{{kind: multisine, from: 8 Hz, to: 60 Hz, period: 2 s, periods: {periods}, force: 1 N}}"
    force = np.tile(synthetic.band_noise(2.0, 8.0, 60.0), 8 + periods)
    marks = [("measure", 8 * period, (8 + periods) * period - 1, fields)]
    return synthetic.record_response(path, force, test, marks, noise=1e-3)


def responses_with_gain(path, folder, channels, gain, first, overloads=()):
    """Return the responses of a recording whose channels have this gain from a sample on, and overloads at samples."""
    with daq.open(path) as rec:
        samples = np.stack([rec.read(name) for name in rec.channels])
        rows = [k for k, name in enumerate(rec.channels) if name in channels]
        samples[rows, first:] *= gain
        marks = [(mark.kind, mark.first_sample, mark.last_sample, mark.fields) for mark in rec.markers]
        marks += [("overload", sample, sample, {"channel": channels[0]}) for sample in overloads]
        changed = synthetic.write(folder / "b.mcap", rec.scene, list(rec.channels.values()), samples, marks)
    return analysis.frequency_responses(changed)


def warnings_with_gain(path, folder, channels, gain, first, overloads=()):
    """Return the warnings of changed gains of a recording whose channels have this gain from a sample on."""
    responses = responses_with_gain(path, folder, channels, gain, first, overloads)
    return [text for group in responses for text in group.warnings if "its gain" in text]


@pytest.mark.parametrize(
    ("channel", "gain", "text"),
    [
        ("body2", 0.5, "body2: its gain changes by a factor of 0.5"),
        ("body3", 0.02, "body3: its gain drops to zero"),
        ("force", 0.5, "force: its gain changes by a factor of 0.5"),
    ],
)
def test_changed_channel_of_random_test_is_named(random_test, tmp_path, channel, gain, text):
    # A change between two of the 16 sections.
    first = round(0.5 * SECONDS * synthetic.RATE)
    [warning] = warnings_with_gain(random_test, tmp_path, [channel], gain, first)
    assert warning.startswith(text) and "at about 20 s" in warning


def test_change_between_overloads_is_named(random_test, tmp_path):
    # Each of the equally spaced sections after the change contains an overload.
    overloads = [round(second * synthetic.RATE) for second in 20.1 + 2.6 * np.arange(8)]
    [warning] = warnings_with_gain(random_test, tmp_path, ["body2"], 0.5, round(20.0 * synthetic.RATE), overloads)
    assert warning.startswith("body2: its gain changes by a factor of 0.5")


@pytest.mark.parametrize(("gain", "text"), [(0.5, "changes by a factor of 0.5"), (0.0, "drops to zero")])
def test_second_of_two_periods_shows_change(tmp_path, gain, text):
    path = multisine(tmp_path / "a.mcap", periods=2)
    [warning] = warnings_with_gain(path, tmp_path, ["body2"], gain, 18 * round(synthetic.RATE))
    assert warning.startswith(f"body2: its gain {text}") and "at about 18 s" in warning


@pytest.mark.parametrize(
    ("periods", "added"),
    [
        # A sensor that settles during the first two periods reads low frequencies too large.
        pytest.param(6, lambda signal: slow_part(signal, 2), id="settling"),
        pytest.param(2, lambda signal: noise_of(signal, 10.0), id="noise"),
    ],
)
def test_neither_settling_nor_noise_is_a_step(tmp_path, periods, added):
    with daq.open(multisine(tmp_path / "a.mcap", periods)) as rec:
        samples = np.stack([rec.read(name) for name in rec.channels])
        first = rec.markers[0].first_sample
        samples[0, first:] += added(samples[0, first:])
        marks = [(mark.kind, mark.first_sample, mark.last_sample, mark.fields) for mark in rec.markers]
        path = synthetic.write(tmp_path / "b.mcap", rec.scene, list(rec.channels.values()), samples, marks)
    assert not any("its gain" in text for group in analysis.frequency_responses(path) for text in group.warnings)


def slow_part(signal, periods):
    """Return the part of a signal below 25 Hz, during the first periods."""
    count = periods * 2 * round(synthetic.RATE)
    spectrum = np.fft.rfft(signal[:count])
    spectrum[np.fft.rfftfreq(count, 1.0 / synthetic.RATE) > 25.0] = 0.0
    return np.append(np.fft.irfft(spectrum, count), np.zeros(signal.size - count))


def noise_of(signal, ratio):
    """Return noise with a multiple of the signal's rms value."""
    return ratio * signal.std() * np.random.default_rng(0).standard_normal(signal.size)


def test_changed_channel_among_hits_is_named(impulses, tmp_path):
    first = 640 + 3 * round(6.0 * synthetic.RATE) - 400
    [warning] = warnings_with_gain(impulses, tmp_path, ["body1"], 1.5, first)
    assert warning.startswith("body1: its gain changes by a factor of 1.5 at about 18")


def test_change_among_five_parts_is_detected():
    for seed in range(20):
        gains = np.array([1.0, 1.0, 0.5, 0.5, 0.5]) + 0.005 * np.random.default_rng(seed).standard_normal(5)
        step = channel_changes._largest_step(gains, np.zeros(5), is_steady=False)
        assert step is not None and step.part == 2


def test_number_of_evaluated_parts_is_limited(impulses, monkeypatch):
    monkeypatch.setattr(channel_changes, "_MAX_PARTS", 5)
    parts = channel_changes.Parts(np.arange(0, 20_000, 1000), 1000, 5.0, 60.0)
    with daq.open(impulses) as rec:
        clean, _, spectra = channel_changes._spectra(rec, parts, list(rec.channels))
    assert clean == [0, 4000, 8000, 12000, 16000] and len(spectra) == 5


def test_change_of_several_channels_is_not_reported(random_test, tmp_path):
    # The structure has changed.
    assert not warnings_with_gain(random_test, tmp_path, ["body1", "body2"], 0.7, 50_000)


def test_intact_channels_are_not_reported(random_test, tmp_path):
    assert not warnings_with_gain(random_test, tmp_path, ["body1"], 1.0, 0)


@pytest.mark.parametrize(
    ("channel", "text"), [("body2", "body2 seems to be (2.0"), ("force", "The force seems to be (2.0")]
)
def test_late_channel_is_named(random_test, channel, text):
    with daq.open(random_test) as rec:
        assert not any("seems to be" in warning for warning in analysis.frfs(rec).warnings)
        # The samples are later than the stated delay.
        rec.channels[channel] = replace(rec.channels[channel], delay=-2e-3)
        assert any(text in warning and "ms late" in warning for warning in analysis.frfs(rec).warnings)


@pytest.mark.parametrize("kind", ["stepped_sine", "swept_sine"])
@pytest.mark.parametrize(("channel", "gain"), [("body2", 0.5), ("force", 0.5), ("body1", 1.3)])
def test_changed_channel_of_sweep_is_named(request, tmp_path, kind, channel, gain):
    path = request.getfixturevalue(kind)
    with daq.open(path) as rec:
        middle = rec.samples // 2
    [warning] = warnings_with_gain(path, tmp_path, [channel], gain, middle)
    assert warning.startswith(f"{channel}: its gain changes by a factor of {str(gain)[:3]}")


@pytest.mark.parametrize("kind", ["stepped_sine", "swept_sine"])
def test_intact_sweep_and_changed_structure_are_not_reported(request, tmp_path, kind):
    path = request.getfixturevalue(kind)
    assert not warnings_with_gain(path, tmp_path, ["body1"], 1.0, 0)
    assert not warnings_with_gain(path, tmp_path, ["body1", "body2"], 0.7, 40_000)


def test_changed_channel_of_few_tones_is_named(tmp_path):
    infos = synthetic.channels()
    path = synthetic.stepped_sine(tmp_path / "a.mcap", [9.0, 14.0, 21.0, 33.0], periods=40, infos=infos, noise=1e-8)
    # Within the second tone.
    first = round((40.0 / 9.0 + 20.0 / 14.0) * synthetic.RATE)
    [warning] = warnings_with_gain(path, tmp_path, ["body2"], 0.5, first)
    assert warning.startswith("body2: its gain changes by a factor of 0.5 at about 14 Hz")
    assert not warnings_with_gain(path, tmp_path, ["body2"], 1.0, first)


@pytest.mark.parametrize("kind", ["random_test", "stepped_sine", "swept_sine"])
@pytest.mark.parametrize("channel", ["force", "body3"])
def test_failed_channel_is_named_and_omitted(request, tmp_path, kind, channel):
    path = request.getfixturevalue(kind)
    with daq.open(path) as rec:
        middle, time = rec.samples // 2, rec.samples // 2 / rec.rate
    [intact] = analysis.frequency_responses(path)
    [response] = responses_with_gain(path, tmp_path, [channel], 1e-6, middle)
    assert any(text.startswith(f"{channel}: disconnected or failed from {time:.4g} s") for text in response.warnings)
    assert not any("its gain" in text for text in response.warnings)
    # What is measured before is right.
    value = np.array([np.interp(response.frequency, intact.frequency, row) for row in intact.value[:, :, 0].T])
    assert np.median(abs(response.value[:, :, 0].T / value - 1.0)) < 0.01


def test_failure_early_in_block_is_detected(random_test):
    with daq.open(random_test) as rec:
        # A block has four periods of the lowest frequency; 0.5 % of the first failed block contains the signal.
        block = 4 * round(rec.rate / 5.0)
        read, first = rec.read, 20 * block + block // 200
        samples = read("body3")
        samples[first:] *= 1e-6
        rec.read = lambda name, start=0, stop=None: (samples if name == "body3" else read(name))[start:stop]
        assert failed_channels(rec) == {"body3": first}


def test_signal_below_a_count_is_not_dead(random_test, tmp_path):
    with daq.open(random_test) as rec:
        samples = np.stack([rec.read(name) for name in rec.channels])
        infos, middle = list(rec.channels.values()), rec.samples // 2
        count = 0.8 * samples[0].std()
        infos[0] = replace(infos[0], volts_per_count=count * infos[0].sensitivity)
        samples[0, middle:] *= 0.05
        samples[0] = count * np.round(samples[0] / count)
        marks = [(mark.kind, mark.first_sample, mark.last_sample, mark.fields) for mark in rec.markers]
        path = synthetic.write(tmp_path / "b.mcap", rec.scene, infos, samples, marks)
    with daq.open(path) as rec:
        assert not failed_channels(rec)


def test_settling_sensor_is_not_dead(random_test, tmp_path):
    with daq.open(random_test) as rec:
        samples = np.stack([rec.read(name) for name in rec.channels])
        samples[0] += 1e4 * samples[0].std() * np.exp(-np.arange(rec.samples) / (0.2 * rec.rate))
        marks = [(mark.kind, mark.first_sample, mark.last_sample, mark.fields) for mark in rec.markers]
        path = synthetic.write(tmp_path / "b.mcap", rec.scene, list(rec.channels.values()), samples, marks)
    with daq.open(path) as rec:
        assert not failed_channels(rec)


def test_noise_at_antiresonance_is_no_change_of_gain():
    # Three neighboring lines of a sweep have a common error.
    frequency = np.linspace(11.0, 90.0, 390)
    modes = [1.0 / (natural**2 - frequency**2 + 0.04j * natural * frequency) for natural in (22.0, 60.0)]
    random, error = np.random.default_rng(2), np.full(390, 2e-5)
    noise = error[0] * np.repeat(random.standard_normal(130) + 1j * random.standard_normal(130), 3)
    curves = []
    for name, value in (("body1", modes[0]), ("body2", modes[0] + modes[1] + noise)):
        curve = Response.curve(frequency, value, name, error=error, degrees_of_freedom=np.full(390, 38.0))
        curves.append(replace(curve, uncertainty=replace(curve.uncertainty, shared=3.0)))
    assert abs(curves[1].value).min() < 5.0 * error[0]
    assert not step_warnings(stack(curves), is_linear=True)


def curves_with_step(log_ratio, error):
    """Return two curves of two modes; from 40 Hz on, the first has a step of its gain, in every line of three."""
    frequency = np.linspace(11.0, 90.0, 390)
    modes = [1.0 / (natural**2 - frequency**2 + 0.04j * natural * frequency) for natural in (22.0, 60.0)]
    values = [(modes[0] - modes[1]) * np.exp(log_ratio * (frequency > 40.0)), modes[0] + modes[1]]
    curves = [Response.curve(frequency, value, f"body{k}", error=error) for k, value in enumerate(values)]
    return stack([replace(curve, uncertainty=replace(curve.uncertainty, shared=3.0)) for curve in curves])


def test_line_of_unknown_uncertainty_hides_no_step():
    error = np.full(390, 1e-6)
    error[129::21] = np.nan
    # No ratio fits: the phase changes as well.
    [warning] = step_warnings(curves_with_step(0.5 + 0.5j, error), is_linear=True)
    assert warning.startswith("body0: its gain")


@pytest.mark.parametrize(
    ("kind", "row"),
    # The response to the swept sine beats in the middle of the test.
    [(kind, row) for kind in ("random_test", "stepped_sine", "impulses") for row in (1, -1)] + [("swept_sine", -1)],
)
def test_channel_that_becomes_late_is_named(request, kind, row):
    with daq.open(request.getfixturevalue(kind)) as rec:
        channel, read, first = list(rec.channels)[row], rec.read, rec.samples // 2 + 300
        samples = read(channel)
        samples[first:] = samples[first - 5 : -5]
        rec.read = lambda name, start=0, stop=None: (samples if name == channel else read(name))[start:stop]
        # The mean delay over the test is not reported.
        [warning] = [text for text in analysis.frfs(rec).warnings if "seems to be" in text]
    # Five samples are 1.95 ms.
    assert re.match(rf"{channel} seems to be (1\.9|2) ms late .*from about", warning)


def test_delay_hides_no_gain_of_another_channel(random_test):
    with daq.open(random_test) as rec:
        read, middle = rec.read, rec.samples // 2
        changed = {"body1": read("body1"), "body2": read("body2")}
        changed["body1"][middle:] = changed["body1"][middle - 5 : -5]
        changed["body2"][middle:] *= 0.5
        rec.read = lambda name, start=0, stop=None: changed.get(name, read(name))[start:stop]
        late, halved = (text for text in analysis.frfs(rec).warnings if "in contrast" in text)
    assert late.startswith("body1 seems to be 2 ms late from about")
    assert halved.startswith("body2: its gain changes by a factor of 0.5")


def test_phase_of_tone_states_possible_delays():
    # A delay of 2 ms is 0.6 periods of 300 Hz.
    text = describe_step("body2", 1j * 2.0 * np.pi * 0.4, 300.0)
    assert text.startswith("body2 seems to be 1.3 ms early or 2 ms late (plus or minus whole periods of 3.3 ms)")


def test_long_possible_delays_have_no_exponent():
    text = channel_changes.describe_delay("body2", 1e-3, "5 Hz", "the force", period=0.2)
    possible = "body2 seems to be 1 ms late or 200 ms early (plus or minus whole periods of 200 ms)"
    assert text.startswith(f"{possible}, or the force has the opposite delay, from about 5 Hz on")


def test_phase_of_curve_states_possible_delays():
    frequency = np.linspace(200.0, 500.0, 400)
    value = 1.0 / (220.0**2 - frequency**2 + 4.4j * frequency)
    late = value * np.exp(-2j * np.pi * 1e-3 * frequency * (frequency > 400.0))
    curves = stack([Response.curve(frequency, each, f"body{k}") for k, each in enumerate((late, value))])
    [text] = step_warnings(curves, is_linear=True)
    assert text.startswith("body0 seems to be 1 ms late or 1.5 ms early (plus or minus whole periods of 2.5 ms)")


def test_failed_hammer_is_named(impulses, tmp_path):
    [response] = responses_with_gain(impulses, tmp_path, ["hammer"], 1e-5, 640 + 3 * round(6.0 * synthetic.RATE) - 400)
    assert any(text.startswith("hammer: disconnected or failed") for text in response.warnings)
    assert not any("marker" in text for text in response.warnings)


def test_memory_of_search_is_independent_of_duration(monkeypatch):
    monkeypatch.setattr(tone_steps, "_BATCH_READINGS", 1 << 15)
    noise = np.random.default_rng(0).standard_normal(1000)

    def search(samples):
        rec = SimpleNamespace(
            rate=1000.0, samples=samples, read=lambda _, start, stop: noise[np.arange(start, stop) % 1000]
        )
        return list(tone_steps._blocks_to_search(rec, tone_steps.ToneInterval(0, samples, 0.02), ["a", "b"], []))

    search(1000)
    short, long = (peak_memory(search, samples)[0] for samples in (50_000, 200_000))
    assert long < 1.3 * short
