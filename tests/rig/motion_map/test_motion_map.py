"""The motion map (types of damper motion over frequency and force): its boundaries and its files are correct."""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.base.output_files import create_folder
from rig.core.settings.quantities import LENGTH
from rig.core.system.open_loop_drive import separation_levels, with_ideal_force
from rig.core.system.structural_model import receptance
from rig.studies.motion_map.grid import select_frequencies, select_row_values, vertical_axis
from rig.studies.motion_map.motion_map import KINDS, summarize_map, write_map
from tests.rig.grains.scenes import with_grains
from tests.rig.this_process import pieces_in_this_process
from tests.rig.worker_processes import worker_processes


@pytest.fixture(autouse=True, scope="module")
def _in_this_process() -> Iterator[None]:
    with pieces_in_this_process():
        yield


@pytest.fixture(scope="module")
def fig9_map() -> rig.MotionMap:
    return rig.map_motion("fig9", values=[0.5, 1.0, 3.3, 10.0], frequencies=np.linspace(47.0, 54.0, 8))


def test_damper_is_at_rest_below_take_off_force(fig9_map: rig.MotionMap) -> None:
    below = fig9_map.value[:, None] < 0.98 * fig9_map.take_off
    above = fig9_map.value[:, None] > 1.02 * fig9_map.take_off
    assert below.any() and above.any()
    assert (fig9_map.kind[below] == KINDS.index("riding")).all()
    assert (fig9_map.kind[above] != KINDS.index("riding")).all()


def test_types_follow_in_order_with_force(fig9_map: rig.MotionMap) -> None:
    at_resonance = fig9_map.kind[:, int(np.argmin(fig9_map.take_off))]
    assert (np.diff(at_resonance) >= 0).all()
    assert {"I", "III"} <= {KINDS[k] for k in at_resonance}


def test_regions_have_the_names_of_their_motions(fig9_map: rig.MotionMap) -> None:
    axes = fig9_map.plot()
    assert {"at rest", "Type III"} <= {text.get_text() for text in axes.texts}


def test_row_equals_the_frequency_response(fig9_map: rig.MotionMap) -> None:
    scene = with_ideal_force(rig.load("fig9"))
    scene = scene.replace(test=scene.test.replace(force=10.0))
    response = rig.frequency_response(scene, fig9_map.frequency)
    assert list(response.motion_type) == list(fig9_map.motion[-1])
    np.testing.assert_allclose(response.impacts.sum(axis=0), fig9_map.impacts[-1])


def test_take_off_level_accelerates_damper_at_1_g() -> None:
    scene = rig.load("fig8-three-dampers")
    frequency = np.array([12.0, 33.3, 47.6])
    compliance = receptance(scene, frequency, riding=(1, 2, 3))
    accelerance = np.abs(compliance).max(axis=0) * (2 * np.pi * frequency) ** 2
    np.testing.assert_allclose(
        separation_levels(with_ideal_force(scene), frequency) * accelerance, scene.gravity, rtol=1e-9
    )
    np.testing.assert_allclose(
        separation_levels(scene, frequency), separation_levels(with_ideal_force(scene), frequency), rtol=1e-6
    )


def test_compliant_floor_lowers_take_off_level() -> None:
    scene = with_ideal_force(rig.load("fig8-three-dampers", {"dampers[1].contact": {"duration": "20 ms"}}))
    [level] = separation_levels(scene.replace(dampers=scene.dampers[:1]), np.array([18.0]))
    for factor, is_flying in ((0.98, False), (1.02, True)):
        test = {"kind": "sine", "frequency": 18.0, "force": factor * level}
        response = rig.frequency_response(scene.replace(dampers=scene.dampers[:1], test=test), [18.0])
        assert (response.impacts.sum() > 0) == is_flying, factor


def test_rows_include_value_of_scene_and_take_off() -> None:
    scene = rig.load("fig9")
    frequency = select_frequencies(scene)
    levels = select_row_values(scene, "force", frequency)
    # The scene has a force of 3.3 N and a clearance of 0.98 mm.
    assert np.isclose(levels, 3.3, rtol=1e-12).sum() == 1
    assert levels[0] < separation_levels(scene, frequency).min() < levels[-1]
    clearances = select_row_values(scene, "clearance", frequency)
    assert np.isclose(clearances, 0.98e-3, rtol=1e-12).sum() == 1
    assert np.allclose(np.diff(np.log(clearances)), np.log(clearances[1] / clearances[0]))


def test_frequencies_cluster_at_natural_frequencies() -> None:
    frequency = select_frequencies(rig.load("fig8-three-dampers"))
    assert (frequency[0], frequency[-1], len(frequency)) == (8.0, 60.0, 48)
    assert (np.diff(frequency) > 0.0).all()
    finest = frequency[int(np.argmin(np.diff(frequency)))]
    assert 12.0 < finest < 13.5  # around the first natural frequency


def test_table_drive_becomes_the_axis() -> None:
    scene = rig.loads(
        "structure: {masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {modal: 1 %}}\n"
        "dampers: [{body: 2, mass_ratio: 10 %, clearance: .inf}]\n"
        "shaker: {kind: table, body: 1, spring: 5 kN/m}\n"
        "test: {kind: sine, frequency: 14 Hz, drive: 1 mm}\n"
    )
    result = rig.map_motion(scene, values=[2e-5, 1e-3], frequencies=[12.0, 14.0])
    assert (result.over, result.unit) == ("drive", "m")
    assert (result.kind[0] == KINDS.index("riding")).all()
    with pytest.raises(SceneError, match="expected drive"):
        rig.map_motion(scene, over="force")


def test_slips_of_a_joint_are_mapped() -> None:
    result = rig.map_motion("friction-joint", values=[0.1, 1.0], frequencies=[12.0, 13.1])
    assert result.columns()["joint1_motion"].tolist() == ["linear", "linear", "linear", "2 slips per 1"]
    np.testing.assert_array_equal(result.value[:, None] > result.take_off, result.kind > 0)
    with pytest.raises(SceneError, match="no damper with a wall"):
        rig.map_motion("friction-joint", over="clearance")


def test_locked_dampers_keep_their_clearance() -> None:
    scene = rig.load("fig5-three-dampers")
    first, *rest = scene.dampers
    scene = scene.replace(dampers=(first.replace(locked=True), *rest))
    result = rig.map_motion(scene, over="clearance", values=[0.5e-3], frequencies=[48.0, 50.0])
    # Types of motion of the two dampers that are not locked.
    assert len(result.motion[0, 0].split("/")) == 2
    assert vertical_axis(scene, "clearance") == ("clearance", LENGTH)


def test_linear_scene_is_rejected() -> None:
    with pytest.raises(SceneError, match="no damper that can hit a wall"):
        rig.map_motion("fig8-no-damper")


def test_bed_of_grains_is_rejected_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.base.study.Workers", lambda cluster: pytest.fail("workers were started"))
    with pytest.raises(SceneError, match=r"dampers\[1\] is a bed of grains"):
        rig.map_motion(with_grains(), values=[1.0], frequencies=[30.0])


def test_errors_name_the_invalid_range() -> None:
    scene = rig.load("fig9")
    with pytest.raises(SceneError, match="50 to 40 Hz"):
        select_frequencies(scene, 50.0, 40.0)
    with pytest.raises(SceneError, match="got 2 to 1; expected an ascending range"):
        select_row_values(scene, "force", np.array([49.0]), 2.0, 1.0)
    with pytest.raises(SceneError, match="positive"):
        rig.map_motion(scene, values=[-1.0], frequencies=[49.0])


def test_interrupted_map_stops_its_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.core.base.workers.SERIAL", False)

    def interrupt(n_completed: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rig.map_motion("fig9", frequencies=np.linspace(46.0, 54.0, 20), progress=interrupt)
    assert not worker_processes()


def test_interrupted_map_continues_from_stored_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = {"values": [0.5, 1.0, 3.3], "frequencies": [49.0, 50.0], "table_path": tmp_path / "map.kept"}

    def interrupt(n_completed: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rig.map_motion("fig9", **arguments, progress=interrupt)

    def map_and_report() -> tuple[rig.MotionMap, list[int]]:
        """Return the map, and the number of its completed points after each row of two points."""
        reported: list[int] = []
        result = rig.map_motion("fig9", **arguments, progress=lambda n_completed, total: reported.append(n_completed))
        return result, reported

    result, reported = map_and_report()
    assert reported == [2, 4, 6]
    second_result, reported = map_and_report()
    assert reported == [6]
    for name in ("kind", "motion", "impacts", "repetition", "periods", "cpu"):
        np.testing.assert_array_equal(getattr(result, name), getattr(second_result, name))
    monkeypatch.setattr("rig.core.base.study.code_digest", lambda *packages: "other code")
    assert map_and_report()[1] == [2, 4, 6], "rows computed by other code were reused"


@pytest.mark.thorough
def test_file_has_a_row_for_every_point(fig9_map: rig.MotionMap, tmp_path: Path) -> None:
    files = write_map(fig9_map, tmp_path / "new")
    assert [file.suffix for file in files] == [".png", ".svg", ".csv"]
    with files[2].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == fig9_map.kind.size
    assert {row["damper1_motion"] for row in rows} == set(fig9_map.motion.ravel())
    assert "riding" in summarize_map(fig9_map) and "not times of a test" in summarize_map(fig9_map)


@pytest.mark.thorough
def test_times_do_not_change_the_files(fig9_map: rig.MotionMap, tmp_path: Path) -> None:
    slower = replace(fig9_map, cpu=3.0 * fig9_map.cpu)
    for first_file, second_file in zip(
        write_map(fig9_map, tmp_path / "one"), write_map(slower, tmp_path / "other"), strict=True
    ):
        assert first_file.read_bytes() == second_file.read_bytes()


@pytest.mark.thorough
def test_level_and_clearance_maps_coexist(fig9_map: rig.MotionMap, tmp_path: Path) -> None:
    other = replace(fig9_map, over="clearance", unit="m")
    files = [*write_map(fig9_map, tmp_path), *write_map(other, tmp_path)]
    assert len(set(files)) == 6


def test_unusable_folder_is_rejected(tmp_path: Path) -> None:
    file_path = tmp_path / "taken"
    file_path.write_text("", encoding="utf-8")
    with pytest.raises(SceneError, match="Choose another folder"):
        create_folder(file_path / "maps")


def test_map_over_acceleration_of_shaker_table() -> None:
    result = rig.map("shaker-table", least="0.5 m/s^2", most="5 m/s^2", rows=2, points=3)

    assert (result.over, result.unit) == ("drive", "m/s^2") and np.allclose(result.value, [0.5, 5.0])
    assert result.motion[0, 0] == "riding"
