"""Fits on benches that nobody prepared: ``python -m tests.gauntlet.fits --benches 30 --seed 7``.

Each bench is drawn with two to five bodies, up to three dampers, some with contact that lasts, noise, and sensors off
by what data sheets allow; it is recorded without and with its dampers, and a guess that is a fifth off is fitted.
Prints the status of each value, and how often it was so. Exit code 1 where intervals hold too seldom or something
determined is too far off.
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

# What is determined must be as near as this, relative, by the last word of its key.
NEAR = {"modal": 0.03, "alpha": 0.03, "beta": 0.03, "clearance": 0.02, "mass": 0.02, "mass_ratio": 0.02}
FREQUENCY, FEWEST_INSIDE = 1e-4, 0.90
# How far the guess is off, at most.
_GUESS = 0.2


@dataclass(frozen=True)
class Judged:
    """One value: what it is, its status, how far it is off and how far it may be, relative."""

    bench: str
    what: str
    status: str
    off: float
    bound: float


@dataclass(frozen=True)
class Trial:
    """What became of a bench."""

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
    """Landings at once, or ones that last."""
    if dice.chance(0.5):
        return {}
    return {"contact": {"duration": f"{dice.log(0.5, 8.0):.3g} ms"}, "restitution": dice.even(0.05, 0.6)}


def _points(dice: Draw, chain: Settings, modes: list[float]) -> list[float]:
    """Frequencies as a first look at the structure suggests: dense about resonances, sparse between."""
    low, high = 0.6 * modes[0], 1.15 * modes[-1]
    points = set(np.geomspace(low, high, 16).tolist())
    for mode in modes:
        points |= {mode * (1.0 + 0.012 * step * abs(step) / 2.0) for step in range(-4, 5)}
    return sorted({float(f"{point:.5g}") for point in points if low <= point <= high})


def try_out(seed: int, number: int) -> Trial:
    """Record a bench without and with its dampers, fit a guess, and hold it against the truth."""
    scene = spelt_out(draw(seed, number))
    random = np.random.default_rng([seed, number])
    parameters = free_parameters(scene)
    shift = np.exp(random.uniform(-_GUESS, _GUESS, len(parameters)))
    guess = with_values(
        scene, {one.place: one.start * by for one, by in zip(parameters, shift.tolist(), strict=True)}
    ).replace(shaker=None, test=None, channels=None)
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", daq.RunWarning)
        try:
            paths = []
            for name, one in {"bare": scene.replace(dampers=()), "damped": scene}.items():
                if name == "bare" or scene.dampers:
                    paths.append(Path(folder) / f"{name}.mcap")
                    daq.record(one, paths[-1])
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
        Judged(scene.name, one.what, got.status, float(np.log(got.value / one.start)), got.half_width)
        for one, got in zip(parameters, found.parameters, strict=True)
    ]
    omega, _ = natural_modes(*structure_matrices(scene.structure)[::2])
    for mode, true in zip(found.modes, omega / (2 * np.pi), strict=True):
        bound = mode.frequency_bound / mode.frequency
        status = "determined" if bound < FREQUENCY else "roughly"
        values.append(Judged(scene.name, "frequency", status, mode.frequency / true - 1, bound))
    left = sum(int((~one.used).sum()) for one in found.compared)
    note = (
        f"{len(scene.structure.masses)} bodies, {len(scene.dampers)} dampers, variance {found.variance:.2f}"
    )
    return Trial(scene.name, tuple(values), seconds, f"{note}, {left} points left out")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--benches", type=int, default=30, help="how many (default: 30)")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other benches")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    given = parser.parse_args()
    numbers = range(given.first, given.first + given.benches)
    with ProcessPoolExecutor(given.workers) as pool:
        trials = []
        for trial in pool.map(try_out, [given.seed] * given.benches, numbers):
            trials.append(trial)
            print(f"{trial.bench}: {trial.seconds:.0f} s, {trial.note}", flush=True)
            for one in trial.values:
                if abs(one.off) > one.bound or (
                    one.status == "determined" and abs(one.off) > _near(one.what)
                ):
                    print(
                        f"  {one.what} {one.status}: off by {one.off:.3%}, bound {one.bound:.3%}", flush=True
                    )
    return _tell(trials)


def _near(what: str) -> float:
    return FREQUENCY if what == "frequency" else NEAR.get(what, np.inf)


def _tell(trials: list[Trial]) -> int:
    groups: dict[str, list[Judged]] = defaultdict(list)
    for trial in trials:
        for one in trial.values:
            groups[one.what].append(one)
    table = Table(
        "value", "status", "how many", "within 95 % interval", "median off", "worst off", "median interval"
    )
    failed = any(not trial.values for trial in trials)
    inside = total = 0
    for what, values in sorted(groups.items()):
        for status in ("determined", "roughly", "undetermined"):
            some = [one for one in values if one.status == status]
            if not some:
                continue
            off, bound = np.array([abs(one.off) for one in some]), np.array([one.bound for one in some])
            held = int((off <= bound).sum())
            if status == "determined":
                inside, total = inside + held, total + len(some)
                failed |= bool((off > _near(what)).any())
            table.add_row(
                what, status, str(len(some)), f"{held / len(some):.0%}", f"{np.median(off):.3%}", f"{off.max():.3%}",
                f"{np.median(bound):.3%}",
            )  # fmt: skip
    Console(width=120).print(table)
    if total:
        print(f"determined: {total}, within their intervals: {inside / total:.1%}")
        failed |= inside < FEWEST_INSIDE * total
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
