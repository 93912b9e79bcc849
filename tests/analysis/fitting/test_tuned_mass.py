"""Recordings of a tuned mass damper: its modes are those of theory, and a fit finds spring and dashpot."""

from pathlib import Path

import numpy as np
import pytest

import analysis
import daq
import rig

SCENE = rig.load("tuned-mass-damper", {"test.points": 25, "test.from": "9 Hz", "test.to": "21 Hz"})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(daq.record(SCENE, tmp_path_factory.mktemp("tuned") / "tuned.mcap"))


def test_fit_finds_spring_and_dashpot(recording: Path) -> None:
    start = SCENE.replace(dampers=[SCENE.dampers[0].replace(spring=380.0, damping=1.0)])
    fit = analysis.fit(recording, start, free=["dampers.spring", "dampers.damping"])
    [damper] = fit.scene.dampers
    np.testing.assert_allclose((damper.spring, damper.damping), (365.0, 1.19), rtol=1e-4)


def test_damper_report_names_a_mass_without_impacts(recording: Path) -> None:
    with daq.open(recording) as rec:
        [result] = analysis.dampers(rec)
        assert any("a mass on a spring has no impacts" in text for text in result.missing)
        assert result.bodies == ()
        assert np.nanmax(result.energy.dampers / result.energy.supplied) > 0.8
