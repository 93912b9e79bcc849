"""One entry estimates all frequency responses: a matrix for each sweep; the other names are short forms of it."""

from pathlib import Path

import numpy as np
import pytest

import analysis
import daq
from rig.core.base.errors import SceneError

SCENE = {
    "structure": {"masses": ["1 kg", "1 kg"], "springs": ["40 kN/m", "40 kN/m"], "damping": {"modal": "2 %"}},
    "shaker": {"kind": "force", "body": 1},
    "converter": {"rate": "1000 Hz"},
    "test": {"kind": "stepped_sine", "frequencies": ["20 Hz", "40 Hz"], "force": ["1 N", "2 N"], "direction": "both"},
}


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stepped sine at two levels in both directions."""
    return daq.record(SCENE, tmp_path_factory.mktemp("entry") / "steps.mcap")


def test_one_input_is_one_column(steps: Path) -> None:
    sweeps = analysis.frf(steps)
    assert len(sweeps) == 4 and all(sweep.value.shape == (2, 2, 1) for sweep in sweeps)


def test_level_and_direction_select_sweeps(steps: Path) -> None:
    assert len(analysis.frf(steps, level="2 N")) == 2
    [selected] = analysis.frf(steps, level="2 N", direction="down")
    assert selected.frequency.tolist() == [40.0, 20.0]
    with pytest.raises(SceneError, match="no sweep matches"):
        analysis.frf(steps, level="3 N")


def test_short_forms_return_parts_of_the_entry(steps: Path) -> None:
    [selected] = analysis.frf(steps, level=2.0, direction="down")
    whole = analysis.frfs(steps, level=2.0, direction="down")
    assert np.array_equal(whole.value, selected.value)
    curve = analysis.compliance(steps, "body2", level=2.0, direction="down")
    assert np.array_equal(curve.value, selected["body2"].value)
    for function in (analysis.frfs, analysis.compliance, analysis.frequency_responses):
        assert "analysis.frf" in function.__doc__.split("\n")[0]


def test_short_form_requires_one_sweep(steps: Path) -> None:
    with pytest.raises(SceneError, match=r"several sweeps match\. Choose one of level=1, direction='up'"):
        analysis.frfs(steps)
