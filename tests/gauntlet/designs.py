"""Damper designs compared with brute force on random structures: ``python -m tests.gauntlet.designs --seed 7``.

Each structure has two to five bodies, as a chain or with cross springs. `rig design` chooses one to three dampers for
it. Brute force then tries bodies, masses and clearances at twenty times the cost of the search. The designed scene is
recorded and analyzed. Exit code 1: brute force is more than 1 % better, or the recorded reduction differs by more than
0.3 dB.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.stats import qmc

import analysis
import daq
import rig
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import receptance, structure_matrices
from rig.studies.design.choice import COARSE_DENSITY, FINE_DENSITY, Choice, Objective
from rig.studies.design.search import FINAL_DESIGNS, GRID_CLEARANCES, GRID_MASS_RATIOS
from rig.studies.design.worst_peak import Peak
from tests.gauntlet.scenes import Draw, Settings, draw_chain

# Brute force simulates this multiple of the number of frequency responses in the search.
COST_FACTOR = 20
# The peak of the design may exceed the best peak of brute force by at most this fraction.
MAX_EXCESS = 0.01
# The designed and the recorded reduction may differ by at most this, dB.
MAX_DIFFERENCE_DB = 0.3
# Fractions of the mass budget that brute force tries.
_MASS_FRACTIONS = (1.0, 0.7)
# This number of the best choices of brute force is computed again on the final frequency grid of the design.
_FINALISTS = 8
# Distance of the seeds from the seeds of the other random scenes.
_SEED_OFFSET = 80_000


def draw_scene(seed: int, number: int) -> tuple[rig.Scene, dict[str, Any]]:
    """Draw a scene without dampers, and the arguments of `rig.design`; both are determined by seed and number."""
    random = Draw(seed, number + _SEED_OFFSET)
    while True:
        chain, _ = draw_chain(random)
        if 2 <= (bodies := len(chain["masses"])) <= 5:
            break
    structure = _add_cross_spring(random, chain) if random.chance(0.5) else chain
    driven = random.integer(1, bodies)
    sensor = {"sensitivity": "100 mV/g", "noise": "20 ug/sqrt(Hz)"}
    channels: list[Settings] = [
        {"name": f"body{k}", "at": f"body {k}", "accelerometer": sensor} for k in range(1, bodies + 1)
    ]
    shaker: Settings = {"kind": "force", "body": driven}
    if random.chance(0.5):
        shaker = {"kind": "table", "body": driven, "spring": round(chain["springs"][0] * random.uniform(0.1, 0.5), 1)}
        channels.append({"name": "table", "at": "table", "accelerometer": sensor})
    else:
        # A force sensor has the settings of a hammer.
        channels.append(
            {"name": "force", "at": "shaker", "hammer": {"sensitivity": "11.2 mV/N", "noise": "1e-4 N/sqrt(Hz)"}}
        )
    settings: Settings = {
        "name": f"structure {seed}/{number}", "structure": structure, "shaker": shaker,
        "test": {"kind": "sine", "frequency": 20.0, "force": 1.0}, "channels": channels,
        "converter": {"rate": 8192.0, "bits": 24, "range": 20.0}, "recording": {"display": False},
    }  # fmt: skip
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=str(settings["name"]))
    mass, _, stiffness = structure_matrices(scene.structure)
    natural_frequencies = natural_modes(mass, stiffness)[0] / (2 * np.pi)
    first_mode = random.integer(0, bodies - 1)
    last_mode = random.integer(first_mode, min(first_mode + 2, bodies - 1))
    low, high = 0.85 * natural_frequencies[first_mode], 1.15 * natural_frequencies[last_mode]
    resonances = natural_frequencies[(natural_frequencies > low) & (natural_frequencies < high)]
    frequencies = np.unique(np.append(np.linspace(low, high, 4001), resonances))
    peak_accelerance = float((np.abs(receptance(scene, frequencies)) * (2 * np.pi * frequencies) ** 2).max())
    # Without dampers, this force causes an acceleration of 3 to 12 g at the largest resonance peak.
    force = float(f"{random.log_uniform(3.0, 12.0) * 9.81 / peak_accelerance:.4g}")
    requirements = {
        "budget": f"{random.uniform(2.0, 10.0)} %", "dampers": min(random.integer(1, 3), bodies), "band": (low, high),
        "levels": [factor * force for factor in (0.5, 1.0, 2.0)],
    }  # fmt: skip
    return scene.replace(test=scene.test.replace(force=force)), requirements


def _add_cross_spring(random: Draw, chain: Settings) -> Settings:
    """Return the matrices of a chain with an additional spring, to the ground or to a body that is not adjacent."""
    scene = rig.loads(yaml.safe_dump({"name": "chain", "structure": chain}))
    mass, damping, stiffness = structure_matrices(scene.structure)
    bodies = len(mass)
    # Extension of the spring for a unit displacement of each body.
    extension = np.zeros(bodies)
    extension[random.integer(min(1, bodies - 1), bodies - 1)] = 1.0
    if bodies > 2 and random.chance(0.5):
        extension[:] = 0.0
        extension[[0, random.integer(2, bodies - 1)]] = 1.0, -1.0
    spring = random.log_uniform(0.3, 1.5) * stiffness.diagonal().mean() / 2
    matrices = {"mass": mass, "damping": damping, "stiffness": stiffness + spring * np.outer(extension, extension)}
    return {"matrices": {name: matrix.tolist() for name, matrix in matrices.items()}}


def brute_force(design: rig.Design, locations: list[tuple[int, ...]]) -> Iterator[Choice]:
    """Yield choices spread evenly over bodies, masses and clearances, at `COST_FACTOR` times the cost of the search.

    `locations`: sets of bodies with a damper.
    """
    levels, dampers = len(design.question.levels), design.space.max_dampers
    search_cost = (
        len(design.trials) * levels
        + len(locations) * len(GRID_MASS_RATIOS) * GRID_CLEARANCES
        + FINAL_DESIGNS * levels * FINE_DENSITY // COARSE_DENSITY
    )
    count = -(-COST_FACTOR * search_cost // (levels * len(locations) * len(_MASS_FRACTIONS)))  # rounded up
    points = qmc.Halton(2 * dampers - 1, scramble=False).random(count)
    clearances = np.exp(
        qmc.scale(points[:, :dampers], *np.log(np.array(design.space.clearance)[:, None] * np.ones(dampers)))
    )
    # The spacings of sorted uniform points are uniformly distributed over all divisions of the total mass.
    divisions = np.sort(points[:, dampers:], axis=1)
    masses = design.space.max_mass * np.diff(divisions, axis=1, prepend=0.0, append=1.0)
    for location in locations:
        for fraction in _MASS_FRACTIONS:
            for mass, clearance in zip(fraction * masses, clearances, strict=True):
                if mass.min() > 0.0:
                    yield Choice(location, tuple(mass.tolist()), tuple(clearance.tolist()))


def worst_peak_below(objective: Objective, levels: list[float], bound: float, choice: Choice) -> float | None:
    """Return the worst peak of a choice, m/N, or None as soon as the peak at a level exceeds a bound."""
    worst = 0.0
    for level in levels:
        worst = max(worst, replace(objective, levels=(level,)).worst(choice).magnitude)
        if worst >= bound:
            return None
    return worst


def best_peak(design: rig.Design, choices: list[Choice], workers: ProcessPoolExecutor) -> float:
    """Return the smallest worst peak of all choices on the final frequency grid of the design, m/N."""
    fine = replace(design.question, density=FINE_DENSITY)
    # The level of the design's worst peak first: most choices already exceed the bound there.
    levels = sorted(fine.levels, key=lambda level: level != design.best.peak.level)
    peak_below = partial(worst_peak_below, design.question, levels, design.best.peak.magnitude)
    candidates = [
        (size, choice)
        for size, choice in zip(workers.map(peak_below, choices, chunksize=20), choices, strict=True)
        if size is not None
    ]
    finalists = [choice for _, choice in sorted(candidates, key=lambda candidate: candidate[0])[:_FINALISTS]]
    return min((peak.magnitude for peak in workers.map(fine.worst, finalists)), default=np.inf)


def record_compliance(scene: rig.Scene, peak: Peak, folder: Path) -> float:
    """Record a scene, and return the largest measured compliance of the peak's body at the peak's level, m/N."""
    path = folder / "check.mcap"
    path.unlink(missing_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        daq.record(scene, path)
    with daq.open(path) as recording:
        measured = analysis.compliance(recording, f"body{peak.body}", level=peak.level)
        return float(np.abs(measured.value).max())


def run_trial(seed: int, number: int, workers: ProcessPoolExecutor) -> bool:
    """Design dampers, compare them with brute force and with a recording, and print it; return whether both agree."""
    scene, requirements = draw_scene(seed, number)
    start = time.perf_counter()
    design = rig.design(scene, **requirements)
    seconds = time.perf_counter() - start
    locations = [location for location in design.space.locations if len(location) == design.space.max_dampers]
    choices = list(brute_force(design, locations))
    best = best_peak(design, choices, workers)
    brute_force_seconds = time.perf_counter() - start - seconds
    peak, bare_peak = design.best.peak, design.bare
    with tempfile.TemporaryDirectory() as folder:
        damped = record_compliance(design.scene, peak, Path(folder))
        test = {"kind": "stepped_sine", "frequencies": [bare_peak.frequency], "force": bare_peak.level}
        bare = record_compliance(scene.replace(test=test), bare_peak, Path(folder))
    difference_db = 20 * np.log10(bare / damped) - design.reduction(peak)
    low, high = requirements["band"]
    excess = max(peak.magnitude / best - 1, 0.0)
    print(
        f"{scene.name}: {scene.structure.bodies} bodies, {low:.3g} to {high:.3g} Hz: "
        f"{design.best.choice}: {design.reduction(peak):.2f} dB, {len(design.trials)} trials, {seconds:.0f} s; "
        f"brute force: {len(choices)} trials, {brute_force_seconds:.0f} s; the design's peak is {excess:.2%} higher "
        f"than the best of them; the recorded reduction differs by {difference_db:+.3f} dB",
        flush=True,
    )
    return excess <= MAX_EXCESS and abs(difference_db) <= MAX_DIFFERENCE_DB


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--structures", type=int, default=5, help="number of structures (default: 5)")
    parser.add_argument("--first", type=int, default=0, help="number of the first structure")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other structures")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.structures)
    with ProcessPoolExecutor() as workers:
        agreements = [run_trial(options.seed, number, workers) for number in numbers]
    return int(not all(agreements))


if __name__ == "__main__":
    sys.exit(main())
