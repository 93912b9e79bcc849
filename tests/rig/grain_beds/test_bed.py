"""The grains of one cavity: weight, rebound, and packing."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from rig.arrays import Array
from rig.errors import RunError
from rig.grain_beds import packing
from rig.grain_beds.bed import Bed
from rig.grain_beds.packing import settled
from rig.grain_beds.spheres import Spheres, spheres_of
from rig.scene.damper import Grains
from tests.rig.grain_beds.scenes import with_grains


@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("speed", [0.07, 0.6])
def test_grain_rebounds_with_its_restitution(restitution: float, speed: float) -> None:
    lead = Grains(diameter=2e-3, restitution=restitution)
    spheres = Spheres(lead, 4.75e-5, np.inf, 1, 1)
    bed = Bed(spheres, np.array([[0.0, 0.0, 1.13e-3]]), np.inf, 0.0, spheres.longest_step())
    bed.kick(-speed)

    while bed.momentum <= 0.0 or bed.forces().any():
        bed.advance()

    assert bed.momentum / bed.mass == pytest.approx(restitution * speed, rel=0.01)


def drawn(seed: int) -> tuple[Grains, float]:
    """Grains of some stuff, and a speed to throw them with."""
    draw = np.random.default_rng(seed).uniform
    grains = Grains(
        diameter=10 ** draw(-3.3, -1.9),
        restitution=draw(0.1, 0.95),
        modulus=10 ** draw(7.0, 10.5),
        density=draw(1e3, 12e3),
        poisson_ratio=draw(0.0, 0.49),
        friction=draw(0.0, 0.8),
    )
    return grains, float(10 ** draw(-1.7, 0.4))


def thrown(grains: Grains, count: int, speed: float) -> tuple[Bed, Array]:
    """Grains that come down to a floor one behind the other without gravity, and their heights at first.

    So many steps from floor and each other that what follows takes little computing, whatever they are.
    """
    spheres = Spheres(grains, count * grains.density * math.pi / 6.0 * grains.diameter**3, np.inf, count, 1)
    step = spheres.longest_step()
    heights = grains.diameter * (0.5 + np.arange(count)) + speed * step * (20.3 + 3e3 * np.arange(count))
    at = np.column_stack([0.0 * heights, 0.0 * heights, heights])
    bed = Bed(spheres, at, np.inf, 0.0, step)
    bed.kick(-speed)
    return bed, heights


@pytest.mark.parametrize("seed", range(10))
def test_any_grain_material_rebounds_with_its_restitution(seed: int) -> None:
    grains, speed = drawn(seed)
    bed, _ = thrown(grains, 1, speed)

    while bed.momentum < 0.0 or bed.forces().any():
        bed.advance()

    assert bed.momentum / bed.mass == pytest.approx(grains.restitution * speed, rel=0.01)


@pytest.mark.parametrize("seed", range(10, 20))
def test_grains_part_with_their_restitution(seed: int) -> None:
    grains, speed = drawn(seed)
    bed, heights = thrown(grains, 2, speed)
    apart = [float(np.diff(heights)[0])]

    # The lower one comes back from the floor: they near each other at more than its speed.
    while apart[-1] > grains.diameter:
        bed.advance()
        apart.append(float(np.diff(bed.positions[:, 2])[0]))
    closing = apart[-2] - apart[-1]
    while apart[-1] < grains.diameter:
        bed.advance()
        apart.append(float(np.diff(bed.positions[:, 2])[0]))
    bed.advance()
    parting = float(np.diff(bed.positions[:, 2])[0]) - apart[-1]

    assert parting == pytest.approx(grains.restitution * closing, rel=0.01)


def test_settled_bed_rests_and_its_packing_is_kept() -> None:
    spheres = spheres_of(with_grains(grains={"spread": "10 %"}))[0]
    positions = settled(spheres)

    bed = Bed(spheres, positions, np.inf, 9.80665, spheres.longest_step())

    assert bed.forces()[0] == pytest.approx(spheres.mass * 9.80665, rel=1e-3)
    assert np.array_equal(settled(spheres), positions)
    radii = 0.5 * spheres.diameters()
    apart = np.linalg.norm(positions[:, None] - positions, axis=2) + np.diag(np.full(len(radii), np.inf))
    assert (apart - radii[:, None] - radii).min() > -0.01 * radii.min()


@pytest.mark.parametrize(("count", "cavity", "seed"), [(150, 20.5e-3, 2), (120, 9e-3, 1), (120, 9e-3, 2)])
def test_layered_bed_rests_from_the_first_step(count: int, cavity: float, seed: int) -> None:
    lead = Grains(diameter=2e-3, cavity=cavity)
    spheres = Spheres(lead, count * 4.75e-5, np.inf, count, seed)

    bed = Bed(spheres, settled(spheres), np.inf, 9.80665, spheres.longest_step())

    for _ in range(200):
        assert bed.forces()[0] == pytest.approx(spheres.mass * 9.80665, rel=1e-3)
        bed.advance()


def test_creeping_bed_ends_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing, "_REST_FORCE_RATIO", 0.0)
    monkeypatch.setattr(packing, "_MAX_REST_CHECKS", 30)
    spheres = Spheres(Grains(diameter=2e-3, cavity=3e-3), 3 * 4.75e-5, np.inf, 3, 71)

    with pytest.raises(RunError, match="did not come to rest"):
        settled(spheres)


def test_damaged_packing_is_packed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing, "folder", lambda: tmp_path)
    spheres = spheres_of(with_grains(mass="0.1 g", cavity="3 mm"))[0]
    positions = settled(spheres)
    (kept,) = tmp_path.iterdir()
    whole = kept.read_bytes()
    for damaged in (whole[:-9], b"", b"PK\3\4" + whole):
        kept.write_bytes(damaged)

        assert np.array_equal(settled(spheres), positions)
