"""Fits to recordings of random benches: ``python -m tests.gauntlet.fits --benches 30 --seed 7``.

Each bench has two to five bodies, up to three dampers (some with finite-duration contact), noise, and sensors that
deviate as far as data sheets allow. It is recorded without and with its dampers, and fitted from a guess with
errors up to 20 %. Prints the status of each value with its share. Exit code 1: the intervals hold too rarely, or
the error of a determined value is too large.
"""

from __future__ import annotations

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
from analysis.fitting.parameters import free_parameters, spelt_out, with_values
from rig.errors import ShotrigError
from rig.system.structural_model import natural_modes, receptance, structure_matrices
from tests.gauntlet.scenes import Draw, Settings, structure

# Largest relative error of a determined value, by the last word of its key.
NEAR = {"modal": 0.03, "alpha": 0.03, "beta": 0.03, "clearance": 0.02, "mass": 0.02, "mass_ratio": 0.02}
FREQUENCY, FEWEST_INSIDE = 1e-4, 0.90
# Largest relative error of the guess.
_GUESS_ERROR = 0.2


@dataclass(frozen=True)
class Judged:
    """A fitted value: its name, its status, its relative error and its relative 95 % bound."""

    bench: str
    what: str
    status: str
    error: float
    bound: float


@dataclass(frozen=True)
class Trial:
    """Result of the fit to one bench."""

    bench: str
    values: tuple[Judged, ...]
    seconds: float
    note: str


def draw(seed: int, number: int) -> rig.Scene:
    """Draw a bench; same seed and number give the same."""
    dice = Draw(seed, number + 50_000)
    while True:
        chain, modes = structure(dice)
        bodies = len(chain["masses"])
        if 2 <= bodies <= 5 and modes[-1] < 120.0:
            break
    sensor: Settings = {
        "sensitivity": "100 mV/g", "noise": f"{dice.log(5.0, 50.0):.3g} ug/sqrt(Hz)",
        "sensitivity_tolerance": dice.one([0.01, 0.02, 0.05]),
    }  # fmt: skip
    driven = dice.whole(1, bodies)
    channels = [{"name": f"a{k}", "at": f"body {k}", "accelerometer": sensor} for k in range(1, bodies + 1)]
    if dice.chance(0.5):
        shaker: Settings = {"kind": "force", "body": driven}
        head = {"sensitivity": "11.2 mV/N", "noise": "1e-4 N/sqrt(Hz)", "sensitivity_tolerance": 0.02}
        channels.append({"name": "force", "at": "shaker", "hammer": head})
    else:
        shaker = {
            "kind": "table",
            "body": driven,
            "spring": round(chain["springs"][0] * dice.even(0.1, 0.5), 1),
        }
        channels.append({"name": "table", "at": "table", "accelerometer": sensor})
    carriers = sorted({dice.whole(1, bodies) for _ in range(dice.whole(0, 3))})
    dampers = [
        {
            "body": body, "mass_ratio": dice.even(0.03, 0.12),
            "clearance": ".inf" if dice.chance(0.2) else f"{dice.log(0.3, 2.0):.3g} mm",
            **_contact(Draw(seed, number + 60_000 + 1000 * body)),
        }
        for body in carriers
    ]  # fmt: skip
    settings: Settings = {
        "name": f"bench {seed}/{number}", "structure": chain, "dampers": dampers, "shaker": shaker,
        "test": {"kind": "stepped_sine", "frequencies": _points(dice, chain, modes), "force": 1.0},
        "channels": channels, "converter": {"rate": round(max(2048.0, 20.0 * modes[-1]), 1), "bits": 24, "range": 20.0},
        "recording": {"display": False}, "seed": dice.whole(1, 10**6),
    }  # fmt: skip
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=str(settings["name"]))
    frequency = np.array(scene.test.frequencies)
    response = receptance(scene, frequency)
    watched = [body - 1 for body in carriers] or list(range(bodies))
    largest = float(((2 * np.pi * frequency) ** 2 * abs(response[watched]).max(axis=0)).max())
    # At the highest resonance the dampers' bodies would reach some g without them.
    force = float(f"{dice.log(4.0, 12.0) * 9.81 / largest:.4g}")
    return scene.replace(test=scene.test.replace(force=force))


def _contact(dice: Draw) -> Settings:
    """Draw instant or finite-duration contact."""
    if dice.chance(0.5):
        return {}
    return {"contact": {"duration": f"{dice.log(0.5, 8.0):.3g} ms"}, "restitution": dice.even(0.05, 0.6)}


def _points(dice: Draw, chain: Settings, modes: list[float]) -> list[float]:
    """Frequencies that are dense near resonances and sparse elsewhere."""
    low, high = 0.6 * modes[0], 1.15 * modes[-1]
    points = set(np.geomspace(low, high, 16).tolist())
    for mode in modes:
        points |= {mode * (1.0 + 0.012 * step * abs(step) / 2.0) for step in range(-4, 5)}
    return sorted({float(f"{point:.5g}") for point in points if low <= point <= high})


def run_trial(seed: int, number: int) -> Trial:
    """Record a bench without and with its dampers, fit a guess, and compare the fit with the truth."""
    scene = spelt_out(draw(seed, number))
    random = np.random.default_rng([seed, number])
    parameters = free_parameters(scene)
    shift = np.exp(random.uniform(-_GUESS_ERROR, _GUESS_ERROR, len(parameters)))
    guess = with_values(
        scene,
        {
            parameter.place: parameter.start * by
            for parameter, by in zip(parameters, shift.tolist(), strict=True)
        },
    ).replace(shaker=None, test=None, channels=None)
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        try:
            paths = []
            for name, variant in {"bare": scene.replace(dampers=()), "damped": scene}.items():
                if name == "bare" or scene.dampers:
                    paths.append(Path(folder) / f"{name}.mcap")
                    daq.record(variant, paths[-1])
            begun = time.process_time()
            found = analysis.fit(paths, guess)
        except ShotrigError as error:
            return Trial(scene.name, (), time.process_time() - begun, f"refused: {error}")
        except Exception:
            return Trial(
                scene.name, (), time.process_time() - begun, f"wrong: {traceback.format_exc(limit=-3)}"
            )
    seconds = time.process_time() - begun
    if found.misfit:
        return Trial(scene.name, (), seconds, f"misfit: {found.misfit}")
    values = [
        Judged(scene.name, true.what, got.status, float(np.log(got.value / true.start)), got.half_width)
        for true, got in zip(parameters, found.parameters, strict=True)
    ]
    omega, _ = natural_modes(*structure_matrices(scene.structure)[::2])
    for mode, true in zip(found.modes, omega / (2 * np.pi), strict=True):
        bound = mode.frequency_bound / mode.frequency
        status = "determined" if bound < FREQUENCY else "roughly"
        values.append(Judged(scene.name, "frequency", status, mode.frequency / true - 1, bound))
    unused = sum(int((~curve.used).sum()) for curve in found.compared)
    note = (
        f"{len(scene.structure.masses)} bodies, {len(scene.dampers)} dampers, variance {found.variance:.2f}"
    )
    return Trial(scene.name, tuple(values), seconds, f"{note}, {unused} points left out")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--benches", type=int, default=30, help="how many (default: 30)")
    parser.add_argument("--first", type=int, default=0, help="number of the first bench")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other benches")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    given = parser.parse_args()
    numbers = range(given.first, given.first + given.benches)
    with ProcessPoolExecutor(given.workers) as pool:
        trials = []
        for trial in pool.map(run_trial, [given.seed] * given.benches, numbers):
            trials.append(trial)
            print(f"{trial.bench}: {trial.seconds:.0f} s, {trial.note}", flush=True)
            for value in trial.values:
                if abs(value.error) > value.bound or (
                    value.status == "determined" and abs(value.error) > _largest_error(value.what)
                ):
                    print(
                        f"  {value.what} {value.status}: error {value.error:.3%}, bound {value.bound:.3%}",
                        flush=True,
                    )
    return print_summary(trials)


def _largest_error(what: str) -> float:
    return FREQUENCY if what == "frequency" else NEAR.get(what, np.inf)


def print_summary(trials: list[Trial]) -> int:
    groups: dict[str, list[Judged]] = defaultdict(list)
    for trial in trials:
        for value in trial.values:
            groups[value.what].append(value)
    table = Table(
        "value",
        "status",
        "how many",
        "within 95 % interval",
        "median error",
        "largest error",
        "median interval",
    )
    failed = any(not trial.values for trial in trials)
    inside = total = 0
    for what, values in sorted(groups.items()):
        for status in ("determined", "roughly", "undetermined"):
            some = [value for value in values if value.status == status]
            if not some:
                continue
            error, bound = (
                np.array([abs(value.error) for value in some]),
                np.array([value.bound for value in some]),
            )
            held = int((error <= bound).sum())
            if status == "determined":
                inside, total = inside + held, total + len(some)
                failed |= bool((error > _largest_error(what)).any())
            table.add_row(
                what, status, str(len(some)), f"{held / len(some):.0%}", f"{np.median(error):.3%}",
                f"{error.max():.3%}",
                f"{np.median(bound):.3%}",
            )  # fmt: skip
    Console(width=120).print(table)
    if total:
        print(f"determined: {total}, within their intervals: {inside / total:.1%}")
        failed |= inside < FEWEST_INSIDE * total
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
