"""Several tones at once: each force is controlled to its level, in steady state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

import rig
from daq.core.excitation.controlled import controlled
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.steady_tone import SteadyTones, Tone
from rig.core.base.errors import SceneError
from rig.core.scene.excitation import Settle
from rig.core.system.structural_model import receptance
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

FORCE = 1.5  # level of each tone, N


def run_tones(scene, *groups, levels=None, longest=60.0, fields=None):
    """Run groups of tones on the bench of a scene; `longest`: maximum wait, s."""

    def excite(station: Station) -> Excitation:
        tones = SteadyTones(station, [Tone(station.rate, each) for each in groups[0]], controlled(station))
        settle = Settle(tolerance=1e-3, longest=longest)
        yield from tones.run(groups, levels or [FORCE] * len(groups[0]), settle, [2.0] * len(groups), fields or {})

    return run(scene, make_excitation=excite)


def amplitudes_at_once(bench_run: BenchRun, frequencies: Sequence[float]) -> np.ndarray:
    """Return the amplitudes of all channels in the measured interval, (channels, tones), by one least-squares fit."""
    first, stop, _ = bench_run.marks_of("measure")[0]
    time = np.arange(stop - first) / bench_run.bench.rate
    tones = [part(2 * np.pi * each * time) for each in frequencies for part in (np.cos, np.sin)]
    model = np.stack([*tones, np.ones_like(time)], axis=1)
    fitted = np.linalg.lstsq(model, bench_run.readings[:, first:stop].T, rcond=None)[0]
    return np.asarray((fitted[:-1:2] - 1j * fitted[1:-1:2]).T)


@pytest.mark.parametrize("frequencies", [(20.0, 33.3), (41.0, 12.0, 26.5), (20.0, 20.8)])
def test_each_force_is_at_level(frequencies: tuple[float, ...]) -> None:
    bench_run = run_tones(scene_with({"kind": "sine", "frequency": 20.0, "force": FORCE}), frequencies)
    exact = receptance(bench_run.bench.scene, np.array(frequencies))
    amplitudes = amplitudes_at_once(bench_run, frequencies)
    for number, (_, _, fields) in enumerate(bench_run.marks_of("measure")):
        frequency = frequencies[number]
        force = amplitudes[:, number] @ bench_run.force_weights(frequency)
        assert abs(force) == pytest.approx(FORCE, rel=0.006)
        assert (fields["frequency"], fields["settled"]) == (frequency, True)
        assert fields["force"] == pytest.approx(abs(force), rel=2e-3)
        motion = amplitudes[2, number] * bench_run.displacement_factor(2, frequency)
        assert motion / force == pytest.approx(exact[2, number], rel=5e-3)


def test_one_tone_is_a_special_case() -> None:
    scene = scene_with({"kind": "sine", "frequency": 33.3, "force": FORCE, "duration": 2.0})
    of_kind, of_tones = run(scene), run_tones(scene, [33.3])
    assert np.array_equal(of_kind.drive, of_tones.drive)
    assert of_kind.marks == of_tones.marks


def test_tones_share_the_drive_limit() -> None:
    scene = rig.load("fig8-no-damper").replace(test={"kind": "sine", "frequency": 20.0, "force": FORCE})
    assert scene.shaker is not None
    shaker = scene.shaker.model_dump() | {"amplifier": {"limit": "0.2 V"}}
    bench_run = run_tones(scene.replace(shaker=shaker), (20.0, 33.3), longest=3.0)
    assert 0.19 < abs(bench_run.drive).max() <= 0.2
    assert {fields["settled"] for _, _, fields in bench_run.marks_of("measure")} == {False}


def test_close_tones_are_refused_before_the_test() -> None:
    scene = scene_with({"kind": "sine", "frequency": 20.0, "force": FORCE})
    with pytest.raises(SceneError, match=r"by 0\.3 Hz do not settle within 60 s\. Space the tones by at least 0\.4 Hz"):
        run_tones(scene, (12.0, 33.3), (20.0, 20.3))


def test_groups_follow_one_another_with_a_level_per_tone() -> None:
    scene = scene_with({"kind": "sine", "frequency": 20.0, "force": FORCE})
    bench_run = run_tones(scene, (12.0, 31.0), (33.0, 14.5), levels=(1.0, 2.0), longest=20.0)
    fields = [fields for _, _, fields in bench_run.marks_of("measure")]
    assert [(each["frequency"], each["level"]) for each in fields] == [
        (12.0, 1.0),
        (31.0, 2.0),
        (33.0, 1.0),
        (14.5, 2.0),
    ]
    assert [each["force"] for each in fields] == pytest.approx([1.0, 2.0, 1.0, 2.0], rel=0.006)
    assert not bench_run.warnings


def test_tones_of_different_forces_share_a_curve() -> None:
    scene = rig.load("continuation").replace(test={"kind": "sine", "frequency": 12.0, "force": 1.0}, dampers=())
    bench_run = run_tones(scene, (12.0, 31.0), levels=(1.0, 2.0), longest=20.0, fields={"level": 3.0})
    fields = [fields for _, _, fields in bench_run.marks_of("measure")]
    assert [(each["frequency"], each["level"], each["force"]) for each in fields] == [
        (12.0, 3.0, 1.0),
        (31.0, 3.0, 2.0),
    ]
