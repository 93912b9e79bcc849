"""Motions of the engine, in every bit: of the bundled scenes, of the hard cases, and of variants of a chain.

`tests.same_results` compares them between two versions. A processor with other instructions gives other last bits, so
that the results of a version are computed when they are compared, and are not stored.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

PERIODS = 100
RATE = 5120.0  # samples per second
CASES = Path(__file__).parent / "cases"
#: Settings of each damper of the chain, by name of the variant.
DAMPERS: dict[str, dict[str, Any]] = {
    "plastic": {"clearance": "1 mm"},
    "rebound": {"clearance": "1 mm", "restitution": 0.4},
    "elastic": {"clearance": "0.4 mm", "restitution": 0.9},
    "open": {"clearance": ".inf", "restitution": 0.2},
    "timed": {"clearance": "1 mm", "contact": {"duration": "2 ms"}},
    "timed-open": {"clearance": ".inf", "contact": {"duration": "5 ms"}, "restitution": 0.5},
    "springs": {"clearance": "0.5 mm", "contact": {"stiffness": "20 kN/m", "damping": "0 N s/m"}},
    "weightless": {"clearance": "0.5 mm", "restitution": 0.3},
    "shared": {"clearance": "0.7 mm", "restitution": 0.2},
    "shared-plastic": {"clearance": "0.5 mm"},
    "shared-timed": {"clearance": "0.7 mm", "contact": {"duration": "2 ms"}},
    "full-mass": {"clearance": "1 mm"},
    "full-mass-rebound": {"clearance": "0.6 mm", "restitution": 0.5},
    "long": {"clearance": "0.5 mm", "restitution": 0.1},
    "long-timed": {"clearance": "0.5 mm", "contact": {"duration": "3 ms"}},
}


def _chain(variant: str) -> dict[str, Any]:
    """Return the scene of a variant: three bodies with dampers, or ten, which need other tables."""
    bodies = 10 if variant.startswith("long") else 3
    structure: dict[str, Any] = {"masses": [0.7] * bodies, "springs": [22e3] * bodies, "damping": {"modal": 0.005}}
    if variant.startswith("full-mass"):
        stiffness = 2e4 * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
        structure = {
            "matrices": {"mass": (0.6 * np.eye(3) + 0.1).tolist(), "stiffness": stiffness.tolist()},
            "damping": {"modal": 0.01},
        }
    settings = DAMPERS[variant]
    placed = [{"body": body, "mass": "60 g", **settings} for body in range(1, bodies + 1)]
    if variant.startswith("shared"):
        placed += [{"body": 2, "mass": "20 g", "clearance": "1 mm"}, {"body": 2, "mass": "5 g", "clearance": ".inf"}]
    return {
        "name": variant,
        "structure": structure,
        "dampers": placed,
        "gravity": 0.0 if variant == "weightless" else 9.80665,
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": "34 Hz", "force": "9 N"},
    }


def _scenes() -> Iterator[tuple[str, Any]]:
    """Yield names and scenes."""
    import rig
    from rig.core.scene.scene_files import bundled_scenes

    for name in bundled_scenes():
        yield name, rig.load(name)
    for variant in DAMPERS:
        yield variant, rig.load(_chain(variant))
    for path in sorted(CASES.glob("*.yaml")):
        if path.stem.startswith("chain"):  # a hard case of sensors
            continue
        # An older version lacks the keys of newer cases, which are then reported as new.
        with suppress(rig.SceneError):
            yield path.stem, rig.load(path)


def _bits(trajectory: Any) -> list[Any]:
    """Return states, events and discontinuities of a trajectory, without the accelerations that some versions store."""
    return [getattr(trajectory, name) for name in ("event_segment", "event_offset", "event_damper", "event_speed")]


def _tone(scene: Any, level: float) -> list[Any]:
    """Return the motion under the tone of a scene, at a multiple of its amplitude."""
    from rig.core.engine.propagator import tone_propagator
    from rig.core.system.assembly import assemble
    from rig.core.system.open_loop_drive import tone_drive

    system = assemble(scene)
    tone = tone_drive(scene, system)
    if tone is None:
        return []
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    propagator.set_state(tone.state, np.array([level, 0.0]))
    trajectory = propagator.propagate_tone(
        np.full(PERIODS, steps), np.arange(PERIODS), np.ones(PERIODS, dtype=bool), level
    )
    n = propagator.tables.size
    states = (trajectory.state, trajectory.state_before, trajectory.state_after)
    heights = np.where(trajectory.contact == 0, trajectory.height, 0.0)
    return [*_bits(trajectory), *(np.ascontiguousarray(part[:, :n]) for part in states), heights, trajectory.contact]


def _sampled(scene: Any) -> list[Any]:
    """Return the motion under a sine with noise, sampled."""
    from rig.core.simulation.plant import Plant

    plant = Plant(scene, RATE)
    samples = np.arange(int(2.0 * RATE))
    noise = np.random.default_rng(1).standard_normal((len(plant.inputs), samples.size))
    scale = np.array([{"N": 6.0, "V": 2.0, "m": 3e-4}[unit] for unit in plant.drive_units])
    motion = plant.advance(scale[:, None] * (np.sin(220.0 * samples / RATE) + 0.3 * noise))
    names = ["displacement", "velocity", "acceleration", "gap", "contact"]
    # Older versions name a discontinuity a break.
    name = "discontinuity" if hasattr(motion, "discontinuity_offset") else "break"
    names += [f"{name}_offset", f"{name}_acceleration"]
    return [*(getattr(motion, name) for name in names), motion.events["time"], motion.events["speed"]]


def _energy(scene: Any) -> str:
    """Return the energy balance of a run with digits that do not depend on rounding."""
    import rig

    energy = rig.simulate(scene, 0.5, rate=2000).energy
    return " ".join(f"{value:.9g}" for value in (energy.work, energy.dissipated, energy.impacts, energy.contacts))


def _orbit(scene: Any) -> str:
    """Return periodic motions at four frequencies, rounded to 11 digits of the largest value."""
    import rig

    response = rig.orbit_response(scene, np.array([12.0, 33.0, 34.0, 49.0]))
    return np.array2string(response.compliance / np.abs(response.compliance).max(), precision=10)


def engine_results() -> Iterator[tuple[str, Any]]:
    """Yield the name of each motion, and a function that computes it."""
    for name, scene in _scenes():
        for level in (1.0, 0.4):
            yield f"engine: {name}: tone {level}", partial(_tone, scene, level)
        yield f"engine: {name}: sampled", partial(_sampled, scene)
        if name in DAMPERS or name.startswith("reference"):
            yield f"engine: {name}: energy", partial(_energy, scene)
            yield f"engine: {name}: orbits", partial(_orbit, scene)
