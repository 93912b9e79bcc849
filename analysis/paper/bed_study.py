"""One mass against grains, setting by setting: what claim C7 is judged by.

A body with one mode at 50 Hz and a damper of 10 % of its mass, driven at the frequency at which the bed as one mass
lets it move most. What counts is level, clearance and depth of the bed; body and force go with the mass of the bed, so
a narrow cavity with few grains and a smooth side stands for a piece of a wide one.
Results of all settings are kept in the package; `analysis beds` makes them again.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from functools import cache
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from analysis.paper.store import Arrays
from rig.bed_response.steady_bed import SteadyBed, as_one_mass, steady_grains, steady_mass
from rig.errors import RunError
from rig.grains.packing import highest, settled
from rig.grains.spheres import rayleigh_time, spheres_of
from rig.response.frequency_response import frequency_response
from rig.scene.damper import Grains
from rig.scene.scene import STANDARD_GRAVITY, Scene

#: Force over the weight of the body: about 0.15 to 10 N in the third mode of the paper's rig, whose Fig 9 has 0.2.
LEVELS = (0.01, 0.03, 0.08, 0.2, 0.6)
#: m.
CLEARANCES = (0.3e-3, 0.98e-3, 3e-3, math.inf)
#: Grains, and diameter of the cavity in m, that make beds of so many layers.
BEDS = {2: (70, 14.2e-3), 4: (100, 11.3e-3), 6: (120, 10e-3)}
SEEDS = (1, 2, 3)
#: Resonance of the body, Hz; its damping ratio, and the mass of the bed over that of the body.
RESONANCE, DAMPING, MASS_RATIO = 50.0, 0.005, 0.1
#: Periods of a block, and most blocks, in which a steady motion is waited for; two blocks are averaged. A body that its
#: bed damps little takes longer.
BLOCK, MOST, MOST_BELOW = 10, 3, 5
#: Force over the body's weight up to which it does.
LITTLE = 0.03
#: Young's modulus of the grains, Pa.
MODULUS = 1e8
#: Rayleigh's times in a step: statistics of a bed do not ask for the rebound of each grain to 1 %.
STEP = 0.19
#: Frequencies among which the largest motion is looked for, over the resonance.
_TRIED = np.linspace(0.94, 1.01, 15)
#: What is kept of each of both motions.
MEASURES = ("compliance", "floor_impulse", "ceiling_impulse", "energy", "landing", "flight")
_HEADER = (
    "level", "clearance_m", "layers", "seed", "depth_diameters", "frequency_hz",
    *(f"{who}_{name}" for who in ("grains", "mass") for name in (*MEASURES, "motion_type")),
)  # fmt: skip


class Setting(NamedTuple):
    """A point of the study: force over the body's weight, clearance in m, layers of the bed, seed of its packing."""

    level: float
    clearance: float
    layers: int
    seed: int


def settings() -> list[Setting]:
    """List all settings, in an order of which every beginning covers them evenly: one seed after the other."""
    found = []
    for seed in SEEDS:
        points = list(product(LEVELS, CLEARANCES, BEDS))
        order = np.random.default_rng(seed).permutation(len(points))
        found += [
            Setting(level, clearance, layers, seed)
            for level, clearance, layers in map(points.__getitem__, order)
        ]
    return found


def scene_of_bed(setting: Setting, **grains: float) -> Scene:
    """Make the scene of a setting; what is given of the grains goes before the defaults."""
    count, cavity = BEDS[setting.layers]
    chosen = {"diameter": 2e-3, "cavity": cavity, "side_friction": 0.0, "modulus": MODULUS}
    bed = Grains.model_validate(chosen | grains)
    bed = bed.replace(time_step=bed.time_step or STEP * rayleigh_time(bed, bed.density))
    mass = count * bed.density * math.pi / 6.0 * bed.diameter**3
    body = mass / MASS_RATIO
    return Scene.model_validate(
        {
            "name": "bed study",
            "seed": setting.seed,
            "structure": {
                "masses": [body],
                "springs": [body * (2.0 * math.pi * RESONANCE) ** 2],
                "damping": {"modal": DAMPING},
            },
            "dampers": [{"body": 1, "mass": mass, "clearance": setting.clearance, "grains": bed}],
            "shaker": {"kind": "force", "body": 1},
            "test": {
                "kind": "sine", "frequency": RESONANCE, "force": setting.level * body * STANDARD_GRAVITY,
            },
        }
    )  # fmt: skip


def compared(setting: Setting) -> dict[str, str]:
    """Follow the bed of a setting as grains and as one mass; gives a row of the table.

    Dimensionless by the body's stiffness (compliance), by the bed's weight over a period (impulses), by its weight over
    a millimetre (energy); landings in degrees.
    """
    scene = scene_of_bed(setting)
    frequency = steady_frequency(setting.level, setting.clearance)
    (spheres,) = spheres_of(scene).values()
    depth = highest(spheres, settled(spheres)) / spheres.settings.diameter
    row = [repr(float(value)) for value in setting[:2]] + [str(setting.layers), str(setting.seed)]
    row += [f"{depth:.2f}", f"{frequency:.4f}"]
    most = MOST_BELOW if setting.level <= LITTLE else MOST
    row += told(scene, frequency, steady_grains(scene, frequency, BLOCK, most))
    row += _of_mass(setting.level, setting.clearance)
    return dict(zip(_HEADER, row, strict=True))


def follow(path: Path, points: int | None, say: Callable[[str], None]) -> None:
    """Follow the first so many settings and add each to a table as soon as it is there; what is in it stays.

    Raises
    ------
    RunError
        If the file is another one, or cannot be written.
    """
    wanted = settings()[:points]
    try:
        known = {_setting(row) for row in _rows(path)} if path.exists() else set()
        _begin(path)
        missing = [setting for setting in wanted if setting not in known]
        for done, setting in enumerate(missing, 1):
            row = compared(setting)
            with path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, _HEADER, lineterminator="\n").writerow(row)
            say(f"[{done}/{len(missing)}] {_words(setting)}: {_ratio(row)}")
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another place with -o") from None


def kept() -> Path:
    """Give the table that the package brings."""
    return Path(str(files("analysis.paper") / "data" / "beds.csv"))


def table(path: Path | None = None) -> Arrays:
    """Read a table of settings, seeds gathered.

    Returns
    -------
    dict of ndarray
        ``level``, ``clearance``, ``layers``, ``seeds`` (their number), ``depth``, ``frequency``, each (settings,); and
        ``grains_NAME``, ``mass_NAME``, ``error_NAME`` (the standard error of the mean over the seeds, infinite where
        there is one) for each NAME of `MEASURES`, with ``grains_type`` and ``mass_type``.
    """
    groups: dict[tuple[float, float, int], list[dict[str, str]]] = {}
    for row in _rows(path or kept()):
        groups.setdefault(_setting(row)[:3], []).append(row)
    keys = sorted(groups)
    out: Arrays = {
        "level": np.array([key[0] for key in keys]),
        "clearance": np.array([key[1] for key in keys]),
        "layers": np.array([key[2] for key in keys]),
        "seeds": np.array([len(groups[key]) for key in keys]),
        "depth": np.array([np.mean([float(row["depth_diameters"]) for row in groups[key]]) for key in keys]),
        "frequency": np.array([float(groups[key][0]["frequency_hz"]) for key in keys]),
    }
    for name in MEASURES:
        seen = [np.array([float(row[f"grains_{name}"]) for row in groups[key]]) for key in keys]
        mass = np.array([float(groups[key][0][f"mass_{name}"]) for key in keys])
        if name == "landing":
            # About that of the mass, so that 359 and 1 degree are near each other.
            seen = [
                (one - middle + 180.0) % 360.0 - 180.0 + middle
                for one, middle in zip(seen, mass, strict=True)
            ]
        out[f"mass_{name}"], out[f"grains_{name}"] = mass, np.array([one.mean() for one in seen])
        out[f"error_{name}"] = np.array(
            [one.std(ddof=1) / math.sqrt(len(one)) if len(one) > 1 else math.inf for one in seen]
        )
    for who in ("grains", "mass"):
        out[f"{who}_type"] = np.array(
            ["/".join(sorted({row[f"{who}_motion_type"] for row in groups[key]})) for key in keys]
        )
    return out


@cache
def steady_frequency(level: float, clearance: float) -> float:
    """Frequency at which the bed as one mass lets the body move most, Hz."""
    scene = as_one_mass(scene_of_bed(Setting(level, clearance, min(BEDS), 1)))
    response = frequency_response(scene, RESONANCE * _TRIED)
    return float(RESONANCE * _TRIED[np.abs(response.compliance[0]).argmax()])


@cache
def _of_mass(level: float, clearance: float) -> list[str]:
    """Follow the bed as one mass: it moves the same whatever the depth."""
    scene, frequency = (
        scene_of_bed(Setting(level, clearance, min(BEDS), 1)),
        steady_frequency(level, clearance),
    )
    return told(scene, frequency, steady_mass(scene, frequency))


def told(scene: Scene, frequency: float, motion: SteadyBed) -> list[str]:
    """Write the measures of a motion without dimensions, and its type."""
    mass = scene.dampers[0].mass
    assert mass is not None
    stiffness = mass / MASS_RATIO * (2.0 * math.pi * RESONANCE) ** 2
    weight = mass * scene.gravity
    values = (
        stiffness * abs(motion.compliance[0]),
        motion.floor_impulse[0] * frequency / weight,
        motion.ceiling_impulse[0] * frequency / weight,
        motion.energy[0] / (weight * 1e-3),
        motion.landing[0],
        motion.flight[0],
    )
    return [*(f"{value:.5g}" for value in values), str(motion.motion_type[0])]


def _setting(row: dict[str, str]) -> Setting:
    return Setting(float(row["level"]), float(row["clearance_m"]), int(row["layers"]), int(row["seed"]))


def _words(setting: Setting) -> str:
    return (
        f"level {setting.level:g}, clearance {1e3 * setting.clearance:g} mm, {setting.layers} layers, seed "
        f"{setting.seed}"
    )


def _ratio(row: dict[str, str]) -> str:
    ratio = float(row["grains_compliance"]) / float(row["mass_compliance"])
    return f"compliance of grains {100 * (ratio - 1.0):+.1f} % off that of one mass"


def _begin(path: Path) -> None:
    """Have a table end with a whole line, be it that of its titles."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", newline="", encoding="utf-8") as file:
        file.seek(0)
        content = file.read()
        if not content:
            file.write(",".join(_HEADER) + "\n")
        elif not content.endswith("\n"):
            file.write("\n")


def _rows(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != _HEADER:
            raise RunError(f"{path}: is no table of beds; move it, or choose another place with -o")
        # The last line of a study that was ended may be torn.
        yield from (row for row in reader if all(row.values()))
