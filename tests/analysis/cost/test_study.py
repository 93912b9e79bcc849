"""The study of the measurement chain: error and computing time of variants, each of which changes a single effect."""

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import rig
from analysis.studies.cost.figure import table, write
from analysis.studies.cost.study import ChainStudy, chain_study, steady_frequencies
from analysis.studies.cost.variants import GROUPS, expand_chain, scene_setting, variants, without_noise
from daq.core.virtual_bench.bench import Bench
from rig.core.base.errors import RunError, SceneError

ONE_BODY = """
name: one body
structure: {masses: [1 kg], springs: [20 kN/m], damping: {modal: 5 %}}
shaker: {kind: table, body: 1, spring: 5 kN/m}
test: {kind: stepped_sine, from: 15 Hz, to: 30 Hz, points: 20, force: 5 N}
channels:
  - {name: body1, at: body 1, accelerometer: {sensitivity: 100 mV/g, noise: 100 ug/sqrt(Hz), resonance: 2 kHz}}
  - {name: table, at: table, accelerometer: {sensitivity: 100 mV/g, noise: 100 ug/sqrt(Hz), resonance: 2 kHz}}
converter: {rate: 1 kHz, bits: 24, range: 5 V, filter: delta_sigma, remove_delay: true}
"""


@pytest.fixture(scope="module", autouse=True)
def single_repetition() -> Iterator[None]:
    """Record once: these tests check errors, not durations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.studies.cost.study.REPEATS", 1)
        yield


@pytest.fixture(scope="module")
def study() -> ChainStudy:
    return chain_study(rig.loads(ONE_BODY), [24.0])


def error_of(study: ChainStudy, group: str, setting: str) -> float:
    return next(point.error for point in study.points if (point.group, point.setting) == (group, setting))


def test_noise_free_chain_approaches_exact_solution(study: ChainStudy) -> None:
    assert study.without_noise.error < 1e-4
    assert error_of(study, "sample rate", "8000 Hz") < 1e-6
    assert "linear equations" in study.reference


def test_error_grows_with_noise_and_quantization(study: ChainStudy) -> None:
    noise_ratio = error_of(study, "noise", "ten times") / error_of(study, "noise", "the scene's")
    assert 3.0 < noise_ratio < 30.0  # 10, up to the random error
    assert error_of(study, "bits", "12") > 10.0 * error_of(study, "bits", "24")


def test_filter_removes_images_of_the_drive(study: ChainStudy) -> None:
    # The table is driven by linearly interpolated samples, whose image near the sample rate aliases to the tone.
    assert error_of(study, "anti-alias filter", "off") > 100.0 * study.without_noise.error
    assert error_of(study, "sample rate", "250 Hz") < 1e-5


def test_every_group_has_timed_measurements(study: ChainStudy) -> None:
    assert {point.group for point in study.points} == set(GROUPS)
    assert all(point.cpu > 0.0 and point.duration > 1.0 for point in (study.unchanged, *study.points))


def test_low_sensor_resonance_distorts_displacement(study: ChainStudy) -> None:
    low_resonance = next(point for point in study.points if point.setting == "resonance 200 Hz")
    # 1 / (1 - (24/200)^2) is 1.5 % above 1; averaging over the sample interval adds a delay of half a sample.
    assert low_resonance.correction > 0.014
    assert low_resonance.error < 1e-3


@pytest.mark.thorough
def test_table_and_file_list_every_point(study: ChainStudy, tmp_path: Path) -> None:
    files = write(study, tmp_path / "new")
    assert [file.suffix for file in files] == [".png", ".svg", ".csv"]
    with files[2].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 + len(study.points)
    assert all(point.setting in table(study) for point in study.points)


def test_a_variant_changes_one_part_only() -> None:
    scene = expand_chain(rig.load("fig9"))
    # Lowest, resonance and highest frequency, Hz; largest voltage.
    for variant in variants(scene, 46.0, 49.0, 54.0, 1.0):
        assert variant.scene.dampers == scene.dampers
        assert variant.scene.shaker == scene.shaker
        expected = scene if variant.group == "noise" else without_noise(scene)
        assert variant.group in GROUPS
        if variant.group in ("sample rate", "bits", "anti-alias filter"):
            assert variant.scene.channels == expected.channels
        else:
            assert variant.scene.converter.rate == expected.converter.rate
            assert [c.at for c in variant.scene.channels] == [c.at for c in expected.channels]


def test_only_tolerance_variant_has_sensor_tolerances() -> None:
    scene = rig.load("fig9")
    scene = scene.replace(channels=[c.replace(accelerometer={"preset": "PCB 352C33"}) for c in scene.channels])
    settings_with_tolerance = [
        variant.setting
        for variant in variants(expand_chain(scene), 46.0, 49.0, 54.0, 1.0)
        if any(c.accelerometer is not None and c.accelerometer.sensitivity_tolerance for c in variant.scene.channels)
    ]
    assert settings_with_tolerance == ["tolerances, bias"]


def test_expanded_presets_give_equal_samples() -> None:
    scene = rig.load("fig9")
    channels = [c.replace(accelerometer={"preset": "PCB 352C33"}) for c in scene.channels]
    scene = scene.replace(channels=channels, converter={"preset": "NI 9234", "rate": 5000.0})
    drive = np.sin(np.arange(500) * 0.05)[None]
    from_presets, from_values = Bench(scene), Bench(expand_chain(scene))
    assert from_values.rate == from_presets.rate == 5120.0
    np.testing.assert_array_equal(from_values.acquire(drive).samples, from_presets.acquire(drive).samples)
    assert scene_setting(expand_chain(scene), "anti-alias filter") == "on"


def test_steady_frequencies_lie_in_resonance_band() -> None:
    scene = rig.load("fig9")
    frequencies = steady_frequencies(scene)
    assert list(frequencies) == sorted(frequencies)
    assert all(46.0 <= frequency <= 54.0 for frequency in frequencies)


@pytest.mark.thorough
def test_reference_follows_the_recorded_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.studies.cost.study.variants", lambda *_: [])
    scene = rig.loads(ONE_BODY.replace("shaker:", "dampers: [{body: 1, mass_ratio: 10 %, clearance: .inf}]\nshaker:"))
    result = chain_study(scene, [24.0])
    assert "under the drive stated in the recording" in result.reference
    assert result.without_noise.error < 1e-4


def test_missing_force_channel_names_the_remedy() -> None:
    scene = rig.loads(ONE_BODY)
    scene = scene.replace(shaker={"kind": "force", "body": 1}, channels=scene.channels[:1])
    with pytest.raises(SceneError, match=r"\{name: force, at: shaker\}"):
        chain_study(scene)


def test_scene_without_shaker_is_rejected() -> None:
    with pytest.raises(SceneError, match="no shaker"):
        chain_study(rig.load("fig10b-no-damper"))


@pytest.mark.parametrize("frequency", [-3.0, float("nan"), 1e300])
def test_invalid_frequency_is_quoted(frequency: float) -> None:
    with pytest.raises(SceneError, match=re.escape(f"got {frequency}; expected")):
        chain_study(rig.loads(ONE_BODY), [24.0, frequency])


def test_too_small_range_is_reported() -> None:
    scene = rig.loads(ONE_BODY.replace("5 V", "1 mV"))
    with pytest.raises(RunError, match="cannot be measured"):
        chain_study(scene, [24.0])
