"""Scenes fitted to recordings of random scenes: ``python -m tests.gauntlet.fits --benches 30 --seed 7``.

Each random scene has two to five bodies and up to three dampers, some with finite-duration contact. Its sensors have
noise, and deviate up to the limits of their data sheets. It is recorded without and with its dampers, and fitted from a
guess with errors up to 20 %. `analysis.fit` gives each value a status: determined, roughly (determined) or
undetermined. Printed are the number of values and their coverage for each status. Exit code 1: too few true values lie
in their 95 % intervals, or the error of a determined value is too large.
"""

import argparse
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

import analysis
import daq
import rig
from analysis.core.fitting.parameters import free_parameters, with_ratio_per_mode, with_values
from rig.core.base.errors import ShotrigError
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import receptance, structure_matrices
from tests.gauntlet.scenes import Draw, Settings, draw_chain

# A determined parameter has at most this relative error, by the last part of its key in the scene file.
MAX_ERRORS = {"modal": 0.03, "alpha": 0.03, "beta": 0.03, "clearance": 0.02, "mass": 0.02, "mass_ratio": 0.02}
# A determined natural frequency has at most this relative error.
MAX_FREQUENCY_ERROR = 1e-4
# At least this fraction of the determined parameters must lie within their 95 % intervals.
MIN_COVERAGE = 0.90
# A parameter in the guess has at most this relative error.
_GUESS_ERROR = 0.2
# Distances of the seeds from the seeds of the other random scenes.
_SEED_OFFSET = 50_000
_CONTACT_SEED_OFFSET = 60_000


@dataclass(frozen=True)
class ComparedValue:
    """A fitted value, compared with the true value."""

    scene: str
    name: str
    status: str
    error: float
    """Relative error."""
    bound: float
    """Relative 95 % bound."""


@dataclass(frozen=True)
class Trial:
    """Result of the fit to one scene; without values if the fit failed, for the reason in the note."""

    scene: str
    values: tuple[ComparedValue, ...]
    seconds: float
    note: str


def draw_scene(seed: int, number: int) -> rig.Scene:
    """Draw a scene, determined by seed and number."""
    random = Draw(seed, number + _SEED_OFFSET)
    while True:
        chain, natural_frequencies = draw_chain(random)
        bodies = len(chain["masses"])
        if 2 <= bodies <= 5 and natural_frequencies[-1] < 120.0:
            break
    sensor: Settings = {
        "sensitivity": "100 mV/g", "noise": f"{random.log_uniform(5.0, 50.0):.3g} ug/sqrt(Hz)",
        "sensitivity_tolerance": random.choice([0.01, 0.02, 0.05]),
    }  # fmt: skip
    driven = random.integer(1, bodies)
    channels = [{"name": f"a{k}", "at": f"body {k}", "accelerometer": sensor} for k in range(1, bodies + 1)]
    if random.chance(0.5):
        shaker: Settings = {"kind": "force", "body": driven}
        hammer = {"sensitivity": "11.2 mV/N", "noise": "1e-4 N/sqrt(Hz)", "sensitivity_tolerance": 0.02}
        channels.append({"name": "force", "at": "shaker", "hammer": hammer})
    else:
        shaker = {"kind": "table", "body": driven, "spring": round(chain["springs"][0] * random.uniform(0.1, 0.5), 1)}
        channels.append({"name": "table", "at": "table", "accelerometer": sensor})
    damper_bodies = sorted({random.integer(1, bodies) for _ in range(random.integer(0, 3))})
    dampers = [
        {
            "body": body, "mass_ratio": random.uniform(0.03, 0.12),
            "clearance": ".inf" if random.chance(0.2) else f"{random.log_uniform(0.3, 2.0):.3g} mm",
            **_contact(Draw(seed, number + _CONTACT_SEED_OFFSET + 1000 * body)),
        }
        for body in damper_bodies
    ]  # fmt: skip
    rate = round(max(2048.0, 20.0 * natural_frequencies[-1]), 1)
    settings: Settings = {
        "name": f"bench {seed}/{number}", "structure": chain, "dampers": dampers, "shaker": shaker,
        "test": {"kind": "stepped_sine", "frequencies": _test_frequencies(natural_frequencies), "force": 1.0},
        "channels": channels, "converter": {"rate": rate, "bits": 24, "range": 20.0},
        "recording": {"display": False}, "seed": random.integer(1, 10**6),
    }  # fmt: skip
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=str(settings["name"]))
    frequency = np.array(scene.test.frequencies)
    response = receptance(scene, frequency)
    monitored = [body - 1 for body in damper_bodies] or list(range(bodies))
    peak_accelerance = float(((2 * np.pi * frequency) ** 2 * abs(response[monitored]).max(axis=0)).max())
    # Without dampers, their bodies would reach 4 to 12 g at the largest resonance peak.
    force = float(f"{random.log_uniform(4.0, 12.0) * 9.81 / peak_accelerance:.4g}")
    return scene.replace(test=scene.test.replace(force=force))


def _contact(random: Draw) -> Settings:
    """Draw instant or finite-duration contact."""
    if random.chance(0.5):
        return {}
    return {"contact": {"duration": f"{random.log_uniform(0.5, 8.0):.3g} ms"}, "restitution": random.uniform(0.05, 0.6)}


def _test_frequencies(natural_frequencies: list[float]) -> list[float]:
    """Return frequencies that are dense near resonances and sparse elsewhere, Hz."""
    low, high = 0.6 * natural_frequencies[0], 1.15 * natural_frequencies[-1]
    points = set(np.geomspace(low, high, 16).tolist())
    for resonance in natural_frequencies:
        # Nine points within 10 %, with distances to the resonance that grow with the square of their number.
        points |= {resonance * (1.0 + 0.012 * step * abs(step) / 2.0) for step in range(-4, 5)}
    return sorted({float(f"{point:.5g}") for point in points if low <= point <= high})


def run_trial(seed: int, number: int) -> Trial:
    """Record a scene without and with its dampers, fit it from a guess, and compare the values with the true ones."""
    scene = with_ratio_per_mode(draw_scene(seed, number))
    random = np.random.default_rng([seed, number])
    parameters = free_parameters(scene)
    factors = np.exp(random.uniform(-_GUESS_ERROR, _GUESS_ERROR, len(parameters)))
    guess = with_values(
        scene,
        {
            parameter.key_path: parameter.start * factor
            for parameter, factor in zip(parameters, factors.tolist(), strict=True)
        },
    ).replace(shaker=None, test=None, channels=None)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        try:
            paths = []
            for name, variant in {"bare": scene.replace(dampers=()), "damped": scene}.items():
                if name == "bare" or scene.dampers:
                    paths.append(Path(folder) / f"{name}.mcap")
                    daq.record(variant, paths[-1])
            start = time.process_time()
            fit = analysis.fit(paths, guess)
        except ShotrigError as error:
            return Trial(scene.name, (), time.process_time() - start, f"refused: {error}")
        except Exception:
            return Trial(scene.name, (), time.process_time() - start, f"wrong: {traceback.format_exc(limit=-3)}")
    seconds = time.process_time() - start
    if fit.misfit:
        return Trial(scene.name, (), seconds, f"misfit: {fit.misfit}")
    values = [
        ComparedValue(
            scene.name, true.quantity, fitted.status, float(np.log(fitted.value / true.start)), fitted.half_width
        )
        for true, fitted in zip(parameters, fit.parameters, strict=True)
    ]
    mass, _, stiffness = structure_matrices(scene.structure)
    omega, _ = natural_modes(mass, stiffness)
    for mode, true in zip(fit.modes, omega / (2 * np.pi), strict=True):
        bound = mode.frequency_expanded / mode.frequency
        status = "determined" if bound < MAX_FREQUENCY_ERROR else "roughly"
        values.append(ComparedValue(scene.name, "frequency", status, mode.frequency / true - 1, bound))
    n_omitted = sum(int((~curve.is_fitted).sum()) for curve in fit.compared)
    note = f"{len(scene.structure.masses)} bodies, {len(scene.dampers)} dampers, variance {fit.variance:.2f}"
    return Trial(scene.name, tuple(values), seconds, f"{note}, {n_omitted} points omitted")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--benches", type=int, default=30, help="number of scenes (default: 30)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.benches)
    with ProcessPoolExecutor(options.workers) as pool:
        trials = []
        for trial in pool.map(run_trial, [options.seed] * options.benches, numbers):
            trials.append(trial)
            print(f"{trial.scene}: {trial.seconds:.0f} s, {trial.note}", flush=True)
            for value in trial.values:
                if abs(value.error) > value.bound or (
                    value.status == "determined" and abs(value.error) > _max_error(value.name)
                ):
                    print(
                        f"  {value.name} {value.status}: error {value.error:.3%}, bound {value.bound:.3%}", flush=True
                    )
    return print_summary(trials)


def _max_error(name: str) -> float:
    return MAX_FREQUENCY_ERROR if name == "frequency" else MAX_ERRORS.get(name, np.inf)


def print_summary(trials: list[Trial]) -> int:
    """Print a row for each value and status; return the exit code."""
    groups: dict[str, list[ComparedValue]] = defaultdict(list)
    for trial in trials:
        for value in trial.values:
            groups[value.name].append(value)
    table = Table(
        "value", "status", "number", "within 95 % interval", "median error", "largest error", "median interval"
    )
    failed = any(not trial.values for trial in trials)
    n_inside = n_determined = 0
    for name, values in sorted(groups.items()):
        for status in ("determined", "roughly", "undetermined"):
            selected = [value for value in values if value.status == status]
            if not selected:
                continue
            error = np.array([abs(value.error) for value in selected])
            bound = np.array([value.bound for value in selected])
            n_covered = int((error <= bound).sum())
            if status == "determined":
                n_inside, n_determined = n_inside + n_covered, n_determined + len(selected)
                failed |= bool((error > _max_error(name)).any())
            table.add_row(
                name, status, str(len(selected)), f"{n_covered / len(selected):.0%}", f"{np.median(error):.3%}",
                f"{error.max():.3%}",
                f"{np.median(bound):.3%}",
            )  # fmt: skip
    Console(width=120).print(table)
    if n_determined:
        print(f"determined: {n_determined}, within their intervals: {n_inside / n_determined:.1%}")
        failed |= n_inside < MIN_COVERAGE * n_determined
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
