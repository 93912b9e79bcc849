"""The check of intact channels counts a blamed channel as wrong."""

from pathlib import Path

import numpy as np
import pytest

import daq
from tests.analysis.responses import synthetic
from tests.gauntlet.checks import channels
from tests.gauntlet.checks.channels import blames
from tests.gauntlet.faults import outcome_of
from tests.gauntlet.result import Case
from tests.gauntlet.scenes import draw


@pytest.mark.parametrize(("gain", "outcome"), [(1.0, "correct"), (1.5, "wrong")])
def test_blamed_channel_is_wrong(tmp_path, gain: float, outcome: str) -> None:
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=8, noise=0.1)) as rec:
        samples = np.stack([rec.read(name) for name in rec.channels])
        samples[0, samples.shape[1] // 2 :] *= gain
        marks = [(mark.kind, mark.first_sample, mark.last_sample, mark.fields) for mark in rec.markers]
        path = synthetic.write(tmp_path / "b.mcap", rec.scene, list(rec.channels.values()), samples, marks)
    with daq.open(path) as changed:
        (result,) = channels.check(Case(changed.scene, changed, []), "impulse")
    assert result.outcome == outcome


@pytest.mark.parametrize(("fault", "outcome"), [("none", "silent"), ("gain halved", "named"), ("2 ms late", "named")])
def test_fault_is_put_into_one_channel(tmp_path, fault: str, outcome: str) -> None:
    path = synthetic.impulses(tmp_path / "a.mcap", hits=8, noise=0.1)
    assert outcome_of(path, "body2", fault)[0] == outcome


@pytest.mark.filterwarnings("ignore::rig.core.base.errors.RunWarning")
def test_tone_that_exceeds_half_a_count_is_no_step(tmp_path: Path) -> None:
    path = daq.record(draw(7402, 12, "swept_sine"), tmp_path / "a.mcap")
    with daq.open(path) as recording:
        assert blames(recording) == []
