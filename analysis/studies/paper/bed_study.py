"""Study of a bed of grains compared with the single-mass model (`analysis beds`): the evidence for claim C7.

A bed is the granular material in the cavity of a damper. The bed is simulated as grains by discrete elements, and as
a single mass without rebound, the model of Inoue, Yokomichi, Hiraki (2011). The bed is in a body a thousand times
as heavy, so both simulations have the same motion of the body. The body vibrates at 50 Hz, near the paper's third
resonance, or at its first or second resonance. The parameters are its acceleration (*level*), the clearance and the
depth. A narrow cavity with few grains and a smooth side represents a section of a wide bed. The dissipated energy
yields the compliance at resonance of a body ten times as heavy as its bed. The package contains the results; `analysis
beds` recomputes them.
"""

import math
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from analysis.studies.paper.store import Arrays
from analysis.studies.paper.stored_table import Row, Table, complete
from rig.core.base.arrays import Array
from rig.core.scene.damper import Grains
from rig.core.scene.scene import STANDARD_GRAVITY, Scene
from rig.core.system.spheres import rayleigh_time, spheres_of
from rig.extras.bed_response.steady_bed import SteadyBed, steady_grains, steady_mass
from rig.extras.grains.lammps_library import lammps_version
from rig.extras.grains.packing import bed_top, settled_positions

#: Clearances [m] for accelerations [g]; infinite: no ceiling. Clearances above the flight height of the mass are
#: omitted, because they are equivalent to no ceiling.
SETTINGS = {
    0.9: (math.inf,),
    1.3: (math.inf,),
    1.7: (math.inf,),
    2.2: (0.15e-3, math.inf),
    3.0: (0.15e-3, 0.3e-3, 0.6e-3, math.inf),
    4.5: (0.15e-3, 0.3e-3, 0.6e-3, 0.98e-3, 2e-3, math.inf),
    7.0: (0.15e-3, 0.3e-3, 0.6e-3, 0.98e-3, 2e-3, math.inf),
}
#: Number of grains, and diameter of the cavity in m, for each number of layers.
BEDS = {2: (70, 14.2e-3), 4: (100, 11.3e-3), 6: (120, 10e-3), 20: (400, 10e-3)}
#: Seeds of the random packings of a bed.
SEEDS = (1, 2, 3)
#: Number of layers for which only `SETTINGS_OF_MAX_LAYERS` and two seeds are simulated, to save computing time.
MAX_LAYERS = 20
SETTINGS_OF_MAX_LAYERS = (
    (1.3, math.inf), (3.0, math.inf), (7.0, math.inf), (4.5, 0.3e-3), (4.5, 0.98e-3), (7.0, 0.98e-3),
)  # fmt: skip
#: Frequency of the settings above [Hz]; the resonance of the heavy body is at half this frequency.
FREQUENCY = 50.0
#: For the paper's first and second resonance [Hz]: clearances in m, and accelerations in g close to the damped peaks in
#: its Figs 8 (without a ceiling) and 9 (clearance 0.98 mm).
SETTINGS_OF_MODES = {
    13.0: {math.inf: (1.3, 1.8, 3.0), 0.98e-3: (1.8, 3.0), 0.3e-3: (1.3,)},
    34.8: {math.inf: (1.3, 2.3, 4.5), 0.98e-3: (2.3, 4.5, 7.0), 0.3e-3: (4.5, 7.0)},
}
#: Numbers of layers that are simulated at the first and at the second resonance.
LAYERS_OF_MODES = (4, 6)
#: Ratio of the mass of the bed to the mass of the shaking body.
SHAKEN_MASS_RATIO = 1e-3
#: Damping ratio of the body whose compliance is reported.
DAMPING = 0.005
#: Ratio of the mass of the bed to the mass of the body whose compliance is reported.
DAMPED_MASS_RATIO = 0.1
#: Number of periods in a block without a ceiling; the last two of three blocks are averaged.
BLOCK_PERIODS = 6
#: Number of periods in a block below a ceiling. Grains that hit a ceiling rearrange for tens of periods, most of all in
#: deep beds. At 7 g and 2 mm, six layers dissipated per period 10 times the bed's weight times 1 mm in the first 18
#: periods, but 7 times in the first 60 periods.
BLOCK_PERIODS_WITH_CEILING = 20
#: Young's modulus of the grains [Pa].
MODULUS_PA = 1e8
#: Ratio of the time step to the Rayleigh time, longer than usual because statistics of a bed do not need the rebound of
#: each grain to 1 %. Twice this step is too long: beds of four and six layers that seldom hit a ceiling at 2 mm then
#: dissipate 10 to 80 % less.
TIME_STEP_RATIO = 0.1
#: Results for grains and for the single mass; see `summary_row`.
MEASURES = ("compliance", "floor_impulse", "ceiling_impulse", "energy", "landing", "flight")
_HEADER = (
    "frequency_hz", "level", "clearance_m", "layers", "seed", "depth_diameters",
    *(f"{model}_{name}" for model in ("grains", "mass") for name in (*MEASURES, "motion_type")),
)  # fmt: skip


TABLE = Table(
    _HEADER,
    "beds of grains compared with the single-mass model",
    "beds.csv",
    integers=("layers", "seed"),
    words=("grains_motion_type", "mass_motion_type"),
)


class Setting(NamedTuple):
    """A point of the study: acceleration [g], clearance [m], layers of the bed, packing seed, frequency [Hz]."""

    level: float
    clearance: float
    layers: int
    seed: int
    frequency: float = FREQUENCY


def settings() -> list[Setting]:
    """List all settings; within a seed in random order, so the first settings are a sample of all settings."""
    pairs = [(level, clearance) for level, clearances in SETTINGS.items() for clearance in clearances]
    listed = []
    for seed in SEEDS:
        points = [(*pair, layers) for pair in pairs for layers in BEDS if layers != MAX_LAYERS]
        order = np.random.default_rng(seed).permutation(len(points))
        shuffled = (points[k] for k in order)
        listed += [Setting(level, clearance, layers, seed) for level, clearance, layers in shuffled]
    of_max_layers = [(*pair, MAX_LAYERS, seed) for seed in SEEDS[:2] for pair in SETTINGS_OF_MAX_LAYERS]
    listed += [Setting(*point) for point in of_max_layers]
    listed += [
        Setting(level, clearance, layers, seed, frequency)
        for seed, layers, (frequency, clearances) in product(SEEDS, LAYERS_OF_MODES, SETTINGS_OF_MODES.items())
        for clearance, levels in clearances.items()
        for level in levels
    ]
    return listed


def scene_of_bed(setting: Setting, **grains: float) -> Scene:
    """Build the scene of a setting; arguments override the defaults of the grains."""
    count, cavity = BEDS[setting.layers]
    grain_settings = {"diameter": 2e-3, "cavity": cavity, "side_friction": 0.0, "modulus": MODULUS_PA}
    bed = Grains.model_validate(grain_settings | grains)
    bed = bed.replace(time_step=bed.time_step or TIME_STEP_RATIO * rayleigh_time(bed, bed.density))
    mass = count * bed.density * math.pi / 6.0 * bed.diameter**3
    body, stiffness_per_mass = mass / SHAKEN_MASS_RATIO, (2.0 * math.pi * setting.frequency) ** 2
    return Scene.model_validate(
        {
            "name": "bed study",
            "seed": setting.seed,
            "structure": {"masses": [body], "springs": [0.25 * body * stiffness_per_mass], "damping": {"modal": 0.05}},
            "dampers": [{"body": 1, "mass": mass, "clearance": setting.clearance, "grains": bed}],
            "shaker": {"kind": "force", "body": 1},
            "test": {
                "kind": "sine", "frequency": setting.frequency,
                "force": 0.75 * setting.level * body * STANDARD_GRAVITY,
            },
        }
    )  # fmt: skip


def compare_beds(setting: Setting) -> Row:
    """Simulate the bed of a setting as grains and as a single mass; return a row of the table."""
    scene = scene_of_bed(setting)
    (spheres,) = spheres_of(scene).values()
    depth = bed_top(spheres, settled_positions(spheres)) / spheres.settings.diameter
    row = [repr(float(value)) for value in (setting.frequency, setting.level, setting.clearance)]
    row += [str(setting.layers), str(setting.seed), f"{depth:.2f}"]
    block = BLOCK_PERIODS if math.isinf(setting.clearance) else BLOCK_PERIODS_WITH_CEILING
    row += summary_row(scene, steady_grains(scene, setting.frequency, block, 3, min_blocks=3))
    row += _mass_summary(setting.frequency, setting.level, setting.clearance)
    return dict(zip(_HEADER, row, strict=True))


def follow(path: Path, points: int | None, print_line: Callable[[str], None], cluster: str | None = None) -> None:
    """Simulate settings and add each result to a table; settings already in the table are not repeated.

    `path`: CSV file; the rows are sorted in the order of `settings` when all are complete; `points`: number of
    settings, from the first; None: all; `print_line`: called with one line of text per setting; `cluster`: see
    `rig.core.base.workers.Workers`. Raises `RunError` if the file is not such a table, or cannot be written.
    """
    study = TABLE.study(compare_beds, setting_of, lammps_version())
    complete(path, study, settings()[:points], _describe_row, print_line, cluster)


def table(path: Path | None = None) -> Arrays:
    """Read a table of settings, averaged over seeds.

    Returns columns of shape (settings,): ``frequency``, ``level``, ``clearance``, ``layers``, ``seeds`` (number of
    seeds) and ``depth``; ``grains_type`` and ``mass_type``; and for each NAME of `MEASURES` ``mass_NAME``,
    ``grains_NAME`` (mean over the seeds) and ``error_NAME`` (standard uncertainty of this mean, infinite for a single
    seed).
    """
    groups: dict[tuple[float, float, float, int], list[Row]] = {}
    for row in TABLE.read(path):
        groups.setdefault(point_of(setting_of(row)), []).append(row)
    keys = sorted(groups)
    columns: Arrays = {
        "frequency": np.array([key[0] for key in keys]),
        "level": np.array([key[1] for key in keys]),
        "clearance": np.array([key[2] for key in keys]),
        "layers": np.array([key[3] for key in keys]),
        "seeds": np.array([len(groups[key]) for key in keys]),
        "depth": np.array([np.mean([float(row["depth_diameters"]) for row in groups[key]]) for key in keys]),
    }
    for name in MEASURES:
        of_seeds = [np.array([float(row[f"grains_{name}"]) for row in groups[key]]) for key in keys]
        mass = np.array([float(groups[key][0][f"mass_{name}"]) for key in keys])
        if name == "landing":
            # Unwrap the phase to within 180 degrees of the phase of the mass so that 359 and 1 degree are close.
            of_seeds = [
                (values - mass_phase + 180.0) % 360.0 - 180.0 + mass_phase
                for values, mass_phase in zip(of_seeds, mass, strict=True)
            ]
        columns[f"mass_{name}"], columns[f"grains_{name}"] = mass, np.array([values.mean() for values in of_seeds])
        columns[f"error_{name}"] = np.array(
            [values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else math.inf for values in of_seeds]
        )
    for model in ("grains", "mass"):
        columns[f"{model}_type"] = np.array(
            ["/".join(sorted({row[f"{model}_motion_type"] for row in groups[key]})) for key in keys]
        )
    return columns


@cache
def _mass_summary(frequency: float, level: float, clearance: float) -> list[str]:
    """Simulate the bed as a single mass; the result does not depend on the depth."""
    scene = scene_of_bed(Setting(level, clearance, min(BEDS), 1, frequency))
    return summary_row(scene, steady_mass(scene, frequency))


def summary_row(scene: Scene, motion: SteadyBed) -> list[str]:
    """Return a row of the table: compliance, impulses, energy, landings and flight of a motion, and its type.

    Impulses are relative to the bed's weight times a period, energy to its weight times 1 mm. Landings are in degrees,
    flight is a share of the period. The compliance is the peak compliance of a body with `DAMPING` and
    `DAMPED_MASS_RATIO`, relative to the compliance of its spring. At the peak the work of the force equals the
    dissipated energy: k X / F = 1 / (2 zeta + E / (pi M omega^2 X^2)).
    """
    mass, test = scene.dampers[0].mass, scene.test
    assert mass is not None
    assert test is not None and test.tone is not None
    weight = mass * scene.gravity
    amplitude = abs(motion.compliance[0]) * test.levels[0]
    vibration_energy = math.pi * mass / DAMPED_MASS_RATIO * (2.0 * math.pi * test.tone * amplitude) ** 2
    values = (
        1.0 / (2.0 * DAMPING + motion.energy[0] / vibration_energy),
        motion.floor_impulse[0] * test.tone / weight,
        motion.ceiling_impulse[0] * test.tone / weight,
        motion.energy[0] / (weight * 1e-3),
        motion.landing[0],
        motion.flight[0],
    )
    return [*(f"{value:.5g}" for value in values), str(motion.motion_type[0])]


def compliance_at_peak(level: Array, energy: Array) -> Array:
    """Compute the compliance of `summary_row` at `FREQUENCY` from acceleration [g] and relative energy; any shape."""
    speed = level * STANDARD_GRAVITY / (2.0 * math.pi * FREQUENCY)
    vibration_energy = math.pi / DAMPED_MASS_RATIO * speed**2
    return np.asarray(1.0 / (2.0 * DAMPING + energy * STANDARD_GRAVITY * 1e-3 / vibration_energy))


def setting_of(row: Row) -> Setting:
    """Return the setting of a row."""
    level, clearance, frequency = (float(row[name]) for name in ("level", "clearance_m", "frequency_hz"))
    return Setting(level, clearance, int(row["layers"]), int(row["seed"]), frequency)


def point_of(setting: Setting) -> tuple[float, float, float, int]:
    """Return the setting without its seed: frequency, acceleration, clearance, layers."""
    return setting.frequency, setting.level, setting.clearance, setting.layers


def describe_clearance(clearance: float) -> str:
    """Describe a clearance [m] for a line of progress."""
    return "no ceiling" if math.isinf(clearance) else f"clearance {1e3 * clearance:g} mm"


def _describe_row(row: Row) -> str:
    level, clearance, layers, seed, frequency = setting_of(row)
    ratio = float(row["grains_compliance"]) / float(row["mass_compliance"])
    return (
        f"{level:g} g at {frequency:g} Hz, {describe_clearance(clearance)}, {layers} layers, seed {seed}: compliance "
        f"with grains {100 * (ratio - 1.0):+.1f} % relative to the single-mass model"
    )
