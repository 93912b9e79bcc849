"""Tests on a shaker table that carries the structure: recordings, responses, modes, comparison, fit and drawings."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.commands.presentation.theory import linear_theory
from analysis.commands.report_page.drawing import rig_drawing
from daq.core.drawing.rig_view import Extremes, RigMotion, RigView
from rig.core.base.errors import RecordingError
from rig.core.system.structural_model import structural_model

SCENE: dict[str, Any] = {
    "structure": {"masses": [0.74, 0.71, 0.64], "springs": [24300, 21800, 19800], "damping": {"modal": 0.02}},
    "shaker": {"kind": "base"},
    "converter": {"rate": 1000},
    "channels": [
        {"name": "base", "at": "table"},
        {"name": "body1", "at": "body 1"},
        {"name": "body2", "at": "body 2"},
        {"name": "body3", "at": "body 3", "accelerometer": {"sensitivity": "100 mV/g"}},
    ],
}
TESTS: dict[str, dict[str, Any]] = {
    "sine": {"frequency": 12.0, "duration": 12.0},
    "stepped_sine": {"frequencies": [12.0, 13.0, 33.0]},
    "swept_sine": {"from": 9.0, "to": 60.0, "duration": 40.0},
    "random": {"from": 5.0, "to": 80.0, "duration": 40.0},
    "multisine": {"from": 9.0, "to": 60.0, "period": 5.0},
}


def record(path: Path, kind: str, **sections: Any) -> Path:
    test = {"kind": kind, "drive": 1.0} | TESTS[kind]
    daq.record(SCENE | {"name": path.stem, "test": test} | sections, path)
    return path


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("base") / "sweep.mcap", "swept_sine")


@pytest.mark.parametrize("kind", TESTS)
def test_measured_transmissibility_is_exact(kind: str, tmp_path: Path) -> None:
    with daq.open(record(tmp_path / "test.mcap", kind)) as rec:
        for frf in analysis.frequency_responses(rec)[0]:
            assert (frf.reference, frf.name, frf.unit) == ("table", "transmissibility", "m/m")
            theory = linear_theory(rec, frf)
            exact = abs(theory.value[:1])
            if frf.frequency.size > 1:
                exact = np.interp(frf.frequency, theory.frequency, abs(theory.value))
            np.testing.assert_allclose(abs(frf.value), exact, rtol=2e-3)


def test_modes_are_those_of_supported_structure(sweep: Path) -> None:
    (modes,) = analysis.modes(sweep)
    exact = structural_model(rig.load(SCENE)).modes
    np.testing.assert_allclose(modes.frequency, exact.frequency, rtol=1e-4)
    np.testing.assert_allclose(modes.damping, 0.02, rtol=1e-2)


def test_fit_finds_springs(sweep: Path) -> None:
    guess = rig.load(SCENE).replace(structure=SCENE["structure"] | {"springs": [25000, 21000, 19000]})
    fitted = analysis.fit([sweep], guess, free=["structure.springs"]).scene
    assert fitted.structure.springs == pytest.approx(SCENE["structure"]["springs"], rel=1e-3)


def test_report_states_transmissibility(sweep: Path, tmp_path: Path) -> None:
    analysis.report([sweep], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert (
        "transmissibility" in page
        and "peak /\N{NO-BREAK SPACE}(m/m)" in page
        and "compliance" not in page.split("<script")[0]
    )


def test_comparison_is_in_ratios(sweep: Path, tmp_path: Path) -> None:
    damped = SCENE["structure"] | {"damping": {"modal": 0.03}}
    other = record(tmp_path / "damped.mcap", "swept_sine", structure=damped)
    comparison = analysis.compare([sweep, other])
    assert "before / (m/m)" in "\n".join(comparison.lines)
    assert comparison.changes[0][2].decibel[0] == pytest.approx(20.0 * np.log10(2.0 / 3.0), abs=0.1)


def test_force_is_refused_as_reference(sweep: Path) -> None:
    with pytest.raises(RecordingError, match=r"Measure the motion of the table instead \(at: table\)"):
        analysis.frf(sweep, reference="force")


def test_prediction_gives_travel_of_table() -> None:
    test = {"kind": "sine", "drive": 1.0} | TESTS["sine"]
    assert "table travel" in str(daq.foresee(SCENE | {"test": test}))


def test_energy_balance_is_refused(tmp_path: Path) -> None:
    dampers = [{"body": 3, "mass_ratio": 0.05, "clearance": "1 mm"}]
    (result,) = analysis.dampers(record(tmp_path / "damped.mcap", "sine", dampers=dampers))
    assert result.energy is None and "no channel measures the force between them" in " ".join(result.warnings)


def test_hammer_test_measures_compliance(tmp_path: Path) -> None:
    channels = [{"name": "hammer", "at": "hammer"}, {"name": "body3", "at": "body 3"}]
    test = {"kind": "impulse", "body": 3, "peak": 50.0, "width": "4 ms", "repeats": 2, "interval": 10.0}
    daq.record(SCENE | {"test": test, "channels": channels}, tmp_path / "hit.mcap")
    (modes,) = analysis.modes(tmp_path / "hit.mcap")
    np.testing.assert_allclose(modes.frequency, structural_model(rig.load(SCENE)).modes.frequency, rtol=1e-3)


def test_structure_is_drawn_on_table() -> None:
    scene = rig.load(SCENE)
    assert "shaker table" in rig_drawing(scene) and ">base<" in rig_drawing(scene)
    view = RigView(scene, Extremes(), gaps_known=True)
    raised = RigMotion(np.full((3, 1), 1e-3), np.full((1, 1), 1e-3))
    parts = {entity: (translation, scale) for entity, translation, scale in view.moving_parts(raised)}
    assert parts["rig/spring_1"][1][0, 2] == pytest.approx(1.0)
    assert parts["rig/spring_1"][0][0, 2] == pytest.approx(parts["rig/table"][0][0, 2])
    assert "rig/coil_spring" not in parts
