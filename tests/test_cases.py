"""Hard cases: every scene in tests/cases meets the requirements in its header.

The header is a comment with these parts, of which all but the first are YAML: `Why hard`; `Run` (simulate the motion
alone, open loop) or `Bench` (with sensors and converter); `Vary` (a setting over a range); `Must hold` (requirements).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import rig
from daq.core.virtual_bench.bench import Bench
from rig.core.laws.events import FLOOR
from rig.core.settings.quantities import FORCE, FREQUENCY, LENGTH, RATIO, TIME, VOLTAGE, parse
from rig.core.system.assembly import assemble

FOLDER = Path(__file__).parent / "cases"
# Samples of a block that the bench acquires at once.
BLOCK_SAMPLES = 65_536


@dataclass(frozen=True)
class Case:
    """A scene file and its header."""

    path: Path
    header: dict[str, Any]

    @classmethod
    def read(cls, path: Path) -> Case:
        """Read the header of a scene file."""
        lines = [line[2:] for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")]
        sections: dict[str, str] = {}
        key = ""
        for line in lines:
            name, colon, remainder = line.partition(": ")
            if colon and name in ("Why hard", "Run", "Bench", "Vary", "Must hold"):
                key, line = name, remainder
            sections[key] = f"{sections.get(key, '')} {line}"
        assert sections.get("Why hard"), f"{path}: the header lacks `Why hard`"
        return cls(path, {name: yaml.safe_load(text) for name, text in sections.items() if name != "Why hard"})

    def scenes(self) -> Iterator[rig.Scene]:
        """Yield the scene, or its variants if the header varies a setting."""
        scene = rig.load(self.path)
        variation = self.header.get("Vary")
        if variation is None:
            yield scene
            return
        ((name, interval),) = variation.items()
        kind = {"clearance": LENGTH, "force": FORCE}[name]
        for value in np.geomspace(parse(interval["from"], kind), parse(interval["to"], kind), interval["points"]):
            if name == "force":
                yield scene.replace(test=scene.test.replace(force=float(value)))
            else:
                yield scene.replace(dampers=[damper.replace(clearance=float(value)) for damper in scene.dampers])


CASES = [Case.read(path) for path in sorted(FOLDER.glob("*.yaml"))]


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES, ids=[case.path.stem for case in CASES])
def test_hard_case_meets_its_requirements(case: Case) -> None:
    for scene in case.scenes():
        if "Bench" in case.header:
            check_measurement(scene, case.header["Bench"], case.header["Must hold"])
        else:
            check_simulation(scene, case.header["Run"], case.header["Must hold"])


def check_simulation(scene: rig.Scene, settings: dict[str, Any], requirements: dict[str, Any]) -> None:
    """Simulate a scene as `Run` in the header says, and check its events and motion."""
    frequency = parse(settings["frequency"], FREQUENCY) if "frequency" in settings else None
    rate = parse(settings.get("rate", "2 kHz"), FREQUENCY)
    run = rig.simulate(scene, parse(settings["duration"], TIME), rate, frequency=frequency)
    check_invariants(run)
    kinds = [str(kind) for kind in run.events["kind"]]
    required_count = requirements.get("events")
    assert len(kinds) > 0 if required_count == "some" else required_count in (None, len(kinds))
    assert requirements.get("kinds", kinds) == kinds
    assert requirements.get("ambiguous", run.ambiguous) == run.ambiguous
    assert len(set(run.events["damper"])) >= requirements.get("dampers", 0)
    if "first" in requirements:
        assert kinds[0] == requirements["first"]
    if "first_time" in requirements:
        assert run.events["time"][0] == parse(requirements["first_time"], TIME)
    if "simultaneous" in requirements:
        # Three equal oscillators have the same motion, except for rounding.
        simultaneous = run.events[: len(run.events) // 3 * 3].reshape(-1, 3)
        for name in ("time", "speed"):
            assert np.ptp(simultaneous[name], axis=1).max() < 1e-14
        assert (simultaneous["kind"] == simultaneous["kind"][:, :1]).all()
        assert np.abs(run.displacement - run.displacement[0]).max() < 1e-15
        assert len(run.events) % 3 == 0 and len(run.events) > 0
    if "drift" in requirements:
        after_transient = len(run.time) // 10
        assert np.ptp(run.displacement[0, after_transient:]) < parse(requirements["drift"], LENGTH)
    if "energy" in requirements:
        losses = run.energy.dissipated + run.energy.impacts
        assert abs(run.energy.residual) < float(requirements["energy"]) * losses
    if "at_rest" in requirements:
        assert (run.contact[:, -1] == FLOOR).all()
        assert np.abs(run.velocity[:, -1]).max() < 1e-12


def check_invariants(run: rig.Run) -> None:
    """Check what is true of any simulation: finite motion, gaps between walls, ordered events, energy balance."""
    for motion in (run.displacement, run.velocity, run.acceleration, run.gap):
        assert np.isfinite(motion).all()
    floor, ceiling = assemble(run.scene).wall_gap[: len(run.gap)].T[:, :, None]
    assert (run.gap >= floor).all()
    assert (run.gap <= ceiling + 1e-12).all()
    assert (np.diff(run.events["time"]) >= 0.0).all()
    energy = run.energy
    exchanged_energy = (
        abs(energy.work) + energy.dissipated + energy.impacts + abs(energy.stored) + abs(energy.stored_before)
    )
    assert abs(energy.residual) <= 1e-10 * exchanged_energy


def check_measurement(scene: rig.Scene, settings: dict[str, Any], requirements: dict[str, Any]) -> None:
    """Measure a scene with sensors and converter as `Bench` in the header says, and check the readings."""
    bench = Bench(scene)
    samples = int(parse(settings["duration"], TIME) * bench.rate)
    drive = sampled_drive(bench, settings.get("drive"), samples)
    readings, overloads, true_motions = [], [], []
    comparison = requirements.get("follows")
    for start in range(0, samples, BLOCK_SAMPLES):
        block = bench.acquire(drive[:, start : start + BLOCK_SAMPLES])
        readings.append(bench.to_units(block.samples))
        overloads.append(block.overload)
        assert np.isfinite(readings[-1]).all()
        if comparison is not None:
            channel = next(c for c in bench.channels if c.name == comparison["channel"])
            row = int(channel.at.removeprefix("body ")) - 1
            true_motions.append(getattr(block.motion, channel.quantity)[row])
    reading = np.concatenate(readings, axis=1)
    if "overloads" in requirements:
        overload = np.concatenate(overloads, axis=1)
        assert overload.any() == requirements["overloads"]
        assert not overload[:, -samples // 10 :].any()
    if "growth" in requirements:
        # The first sixth of the readings contains the transient.
        sixths = np.array_split(reading, 6, axis=1)
        assert np.std(sixths[5]) < requirements["growth"] * np.std(sixths[1])
    if "peak_below" in requirements:
        assert np.abs(reading).max() < parse(requirements["peak_below"], LENGTH)
    if comparison is not None:
        names = [channel.name for channel in bench.channels]
        begin = int(parse(comparison["from"], TIME) * bench.rate)
        measured = reading[names.index(comparison["channel"]), begin:]
        # An integrated acceleration lacks the displacement at power-on.
        true_motion = np.concatenate(true_motions)
        expected = (true_motion - true_motion[0])[begin:]
        assert np.std(measured - expected) < parse(comparison["within"], RATIO) * np.std(expected)
        mean_tolerance = parse(comparison.get("on_average_within", comparison["within"]), RATIO)
        assert abs(np.mean(measured - expected)) < mean_tolerance * np.std(expected)


def sampled_drive(bench: Bench, settings: dict[str, Any] | None, samples: int) -> np.ndarray:
    """Return a tone or a step on the first input; zero if the case has no drive."""
    drive = np.zeros((len(bench.inputs), samples))
    if settings is None:
        return drive
    time = np.arange(samples) / bench.rate
    if "tone" in settings:
        signal = parse(settings["level"], FORCE) * np.sin(2 * np.pi * parse(settings["tone"], FREQUENCY) * time)
    else:
        signal = np.where(time >= parse(settings["at"], TIME), parse(settings["step"], VOLTAGE), 0.0)
    drive[0] = np.where(time < parse(settings.get("until", "1e9 s"), TIME), signal, 0.0)
    return drive
