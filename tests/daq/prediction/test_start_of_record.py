"""`daq record` reports the predicted test, and rejects a test that would abort."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

import daq
import rig
from daq.commands.cli import app
from daq.core.prediction.announcement import reject_certain_abort
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_server.serve import announcement
from rig.commands.cli import app as rig_app
from rig.core.base.errors import RunError, SceneError

HIT = ["record", "fig10b-no-damper", "--set", "test.repeats=1", "--set", "test.interval=0.5s"]
ABORTING_HIT = [*HIT, "--set", "channels[1].abort=10 m/s^2"]


def test_dry_run_reports_maxima_and_records_nothing(tmp_path: Path) -> None:
    path = tmp_path / "hit.mcap"
    result = CliRunner().invoke(app, [*HIT, "--dry-run", "-o", str(path)])
    assert result.exit_code == 0, result.output
    assert "body1" in result.stdout
    assert "test.peak: at most" in result.stdout
    assert not path.exists()


def test_test_that_will_abort_does_not_start(tmp_path: Path) -> None:
    path = tmp_path / "hit.mcap"
    result = CliRunner().invoke(app, [*ABORTING_HIT, "-o", str(path)])
    assert isinstance(result.exception, SceneError)
    assert "body1" in str(result.exception)
    assert "--anyway" in str(result.exception)
    assert not path.exists()


def test_remedy_within_limits_is_no_limit() -> None:
    scene = rig.load("continuation")
    assert scene.test is not None
    foresight = daq.foresee(scene.replace(test=scene.test.replace(settle={"longest": 0.2})))
    with pytest.raises(SceneError, match=r"or increase test\.settle\.longest\. Change the test, or record"):
        reject_certain_abort("curve", foresight)


def test_anyway_starts_test_that_will_abort(tmp_path: Path) -> None:
    path = tmp_path / "hit.mcap"
    result = CliRunner().invoke(app, [*ABORTING_HIT, "--anyway", "-o", str(path)])
    assert isinstance(result.exception, RunError)
    assert "aborted" in str(result.exception)
    assert path.exists()


def test_output_without_suffix_is_a_folder(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, [*HIT, "-o", str(tmp_path / "runs")])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "runs" / "fig10b-no-damper.mcap").is_file()


@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("bare-structure", "table position, 1 mm/V"),
        ("fig8-no-damper", "voltage at the coil, 1 V/V"),
        ("reference-A", "force on body 1, 1 N/V"),
    ],
)
def test_explain_and_server_describe_effect_of_volt(name: str, effect: str) -> None:
    assert f"ao0                      -  {effect}" in str(rig.explain(name)) or effect in str(rig.explain(name))
    chassis = connect_scene(name, "fast")
    assert f"ao0: {effect}" in announcement(chassis, "127.0.0.1", 1, False)


def test_explain_reports_prediction_of_the_test() -> None:
    result = CliRunner().invoke(rig_app, ["explain", "fig10b-no-damper"])
    assert "the test stays within all limits" in result.stdout.partition("recording: 0 states")[2]


def test_explain_without_prediction_lists_effects() -> None:
    result = CliRunner().invoke(rig_app, ["explain", "fig10b-no-damper", "--no-prediction"])
    assert result.stdout == f"{rig.explain('fig10b-no-damper')}\n"
