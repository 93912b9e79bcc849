"""Recordings of a structure with a stop: its true events, and what channels determine of it."""

from pathlib import Path

import numpy as np
import pytest

import analysis
import daq
import rig

SCENE = rig.load(
    {
        "structure": {"masses": {"base": 1.0, "arm": 0.5}, "springs": [3e4, 1.2e4], "damping": {"modal": 0.01}},
        "dampers": [{"body": "arm", "mass": 0.02, "clearance": 5e-4}],
        "joints": [{"between": ["base", "arm"], "gap": 1e-4, "stiffness": 2e5, "damping": 5.0}],
        "shaker": {"kind": "force", "body": "base"},
        "test": {"kind": "stepped_sine", "from": 20.0, "to": 24.0, "points": 3, "force": 10.0},
        "recording": {"truth": True},
    }
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(daq.record(SCENE, tmp_path_factory.mktemp("stop") / "stop.mcap"))


def test_events_of_joint_are_recorded(recording: Path) -> None:
    with daq.open(recording) as rec:
        events = rec.events
    of_joint = events["joint"] == 1
    assert set(events["kind"][of_joint]) == {"touch", "release"}
    np.testing.assert_array_equal(events["damper"], np.where(of_joint, 0, 1))


def test_channels_do_not_determine_contacts_of_joint(recording: Path) -> None:
    with daq.open(recording) as rec:
        results = analysis.dampers(rec)
    for result in results:
        (message,) = result.missing
        assert message.startswith("joint 1, stop between base and arm")
        assert "its force is not measured" in message and "do not show when the joint acts" in message
        assert result.bodies == () and result.energy is not None


def test_response_is_that_of_a_nonlinear_structure(recording: Path) -> None:
    assert not SCENE.is_linear
    with daq.open(recording) as rec:
        measured = analysis.frfs(rec, channels=["arm"])[0]
    expected = rig.frequency_response(SCENE, measured.frequency.tolist())
    steady = expected.converged
    np.testing.assert_allclose(abs(measured.value)[steady], abs(expected.compliance[1])[steady], rtol=0.02)


def test_report_draws_the_stop(recording: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    analysis.report([recording], page)
    text = page.read_text(encoding="utf-8")
    assert 'class="joint"' in text and "stop between base and arm, gap 0.1\N{NO-BREAK SPACE}mm" in text


def test_slips_of_friction_joint_are_recorded(tmp_path: Path) -> None:
    joint = {"between": ["base", "arm"], "slip_force": 2.0, "stiffness": 4e4}
    scene = SCENE.replace(joints=[joint], dampers=[])
    path = Path(daq.record(scene, tmp_path / "friction.mcap"))
    with daq.open(path) as rec:
        assert set(rec.events["kind"]) == {"slip", "stop"} and set(rec.events["joint"]) == {1}
        results = analysis.dampers(rec)
    assert results and all("friction joint between base and arm" in result.missing[0] for result in results)
    analysis.report([path], tmp_path / "report.html")
    assert "slips at 2 N" in (tmp_path / "report.html").read_text(encoding="utf-8")
