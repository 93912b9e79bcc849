from __future__ import annotations

import numpy as np
import pytest

import daq
from analysis.detection import SIGMAS, impacts, score
from daq.channel import ChannelInfo
from rig.errors import RecordingError
from tests.analysis import synthetic

RATE = synthetic.RATE


def blows(path, quantity="displacement", noise=2e-8, count=300, seed=1):
    """A body that swings at 40 Hz and is hit at known times by known velocity jumps."""
    random = np.random.default_rng(seed)
    samples = int(30 * RATE)
    # The converter takes the mean over the interval that ends at the sample: fine steps, then averages.
    t = np.arange(samples) / RATE
    times = 0.05 + np.cumsum(random.uniform(0.02, 0.15, count))
    times = times[times < 29.9]
    jumps = random.choice([-1.0, 1.0], times.size) * random.uniform(3e-3, 2e-2, times.size)
    displacement = 2e-4 * np.sin(2 * np.pi * 40.0 * t)
    velocity = 2e-4 * 2 * np.pi * 40.0 * np.cos(2 * np.pi * 40.0 * t)
    for time, jump in zip(times, jumps, strict=True):
        displacement += jump * np.maximum(t - time, 0.0)
        velocity += jump * (t >= time)
    row = displacement if quantity == "displacement" else np.diff(velocity, prepend=velocity[0]) * RATE
    infos = [ChannelInfo("body1", "body 1", quantity, 1.0, RATE, average=quantity == "acceleration")]
    scale = noise if quantity == "displacement" else noise * RATE**2
    row = row + scale * random.standard_normal(row.size)
    return synthetic.write(path, synthetic.scene(), infos, row[None], []), times, jumps


@pytest.mark.parametrize("quantity", ["displacement", "acceleration"])
def test_given_blows_of_known_size_when_detected_then_times_and_sizes_are_right(tmp_path, quantity):
    path, times, jumps = blows(tmp_path / "a.mcap", quantity)
    with daq.open(path) as rec:
        found = impacts(rec, "body1")
    seen = abs(jumps) > found.threshold
    f1, _, matched = score(found.time, times, 2.0 / RATE)
    assert f1 > 0.98 and matched[seen].mean() > 0.98
    nearest = np.array([np.argmin(abs(times - time)) for time in found.time])
    close = abs(found.time - times[nearest]) < 2.0 / RATE
    assert np.median(abs(found.jump - jumps[nearest])[close]) < 5e-4
    floor = np.where(jumps[nearest] < 0, "floor", "ceiling")
    assert np.mean((found.kind == floor)[close]) > 0.98


def test_given_noise_alone_when_searched_then_nothing_is_found_and_the_threshold_follows_the_noise(tmp_path):
    thresholds = []
    for noise in (1e-8, 1e-7):
        path, _, _ = blows(tmp_path / "a.mcap", noise=noise, count=0)
        with daq.open(path) as rec:
            found = impacts(rec, "body1")
        assert found.time.size == 0
        assert found.threshold == pytest.approx(SIGMAS * found.noise)
        thresholds.append(found.threshold)
    assert 5.0 < thresholds[1] / thresholds[0] < 12.0


def test_given_too_few_samples_when_searched_then_it_says_how_many_are_needed(tmp_path):
    path, _, _ = blows(tmp_path / "a.mcap", count=0)
    with daq.open(path) as rec, pytest.raises(RecordingError, match="take at least 100"):
        impacts(rec, "body1", 0, 50)


def test_given_times_when_scored_then_each_is_matched_once():
    f1, found, true = score(np.array([1.0, 1.01, 2.0]), np.array([1.0, 2.5]), 0.1)
    assert found.tolist() == [True, False, False] and true.tolist() == [True, False]
    assert f1 == pytest.approx(2 / 5)
