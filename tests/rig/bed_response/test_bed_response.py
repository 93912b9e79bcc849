"""Steady-state motion of beds of grains: properties that do not depend on the grains, and the table of results."""

from pathlib import Path

import numpy as np
import pytest

from rig.core.base.errors import RunError, SceneError
from rig.extras.bed_response.bed_response import BedResponse, bed_response, format_table
from rig.extras.bed_response.steady_bed import steady_grains, steady_mass
from tests.rig.grains.scenes import with_grains, without_grains
from tests.rig.this_process import pieces_in_this_process


def test_resting_bed_equals_one_mass() -> None:
    scene = with_grains(test={"kind": "sine", "frequency": 30.0, "force": 0.003})

    grains, mass = steady_grains(scene, 30.0, 1, 10), steady_mass(scene, 30.0)

    assert grains.steady
    assert grains.compliance == pytest.approx(mass.compliance, rel=5e-3)
    weight_impulse = scene.dampers[0].mass * scene.gravity / 30.0  # in a period, N s
    assert (grains.motion_type[0], mass.motion_type[0]) == ("riding", "riding")
    assert grains.floor_impulse[0] == pytest.approx(weight_impulse, rel=5e-3)
    assert mass.floor_impulse[0] == pytest.approx(weight_impulse, rel=5e-3)
    assert grains.ceiling_impulse[0] == 0.0


@pytest.mark.thorough
def test_bed_at_ceiling_dissipates_energy() -> None:
    scene = with_grains()

    for motion in (steady_grains(scene, 30.0, 3, 10), steady_mass(scene, 30.0)):
        net_impulse = motion.floor_impulse - motion.ceiling_impulse
        assert net_impulse == pytest.approx(scene.dampers[0].mass * scene.gravity / 30.0, rel=0.1)
        assert motion.ceiling_impulse[0] > 0.0
        assert motion.energy[0] > 0.0
        assert 0.0 < motion.flight[0] < 1.0


@pytest.mark.thorough
def test_missing_frequencies_of_damaged_table_are_computed(tmp_path: Path) -> None:
    table, progress = tmp_path / "beds.csv", []
    scene = with_grains(test={"kind": "sine", "frequency": 30.0, "force": 0.003})
    # A worker computes the second response.
    with pieces_in_this_process():
        first = bed_response(scene, [250.0, 300.0], periods=1, table=table)
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    table.write_text("".join(lines[:-1]) + lines[-1][:-30])

    second = bed_response(
        scene, [250.0, 300.0], periods=1, table=table, progress=lambda *counts: progress.append(counts)
    )

    assert progress == [(1, 2), (2, 2)]
    for first_column, second_column in zip(first.columns().values(), second.columns().values(), strict=True):
        assert np.array_equal(first_column, second_column)
    # A header, four rows, three lines of notes, an empty line and the summary.
    assert len(format_table(second).splitlines()) == 10
    assert isinstance(second, BedResponse)


def test_other_file_is_rejected(tmp_path: Path) -> None:
    other = tmp_path / "notes.csv"
    other.write_text("mine\n")

    with pytest.raises(RunError, match="is not a table of beds"):
        bed_response(with_grains(), [30.0], table=other)

    assert other.read_text(encoding="utf-8") == "mine\n"


def test_scene_without_grains_is_rejected() -> None:
    with pytest.raises(SceneError, match="no bed of grains"):
        bed_response(without_grains(with_grains()), [30.0])
