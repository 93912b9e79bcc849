"""Random scenes: structure, shaker, test, sensors and converter, all determined by a seed and a number.

Every test takes about a second to record. Scenes are drawn as the content of a scene file: a scene with a wrong result
can be written to a file and run by hand.
"""

from typing import Any

import numpy as np
import yaml

import rig
from daq.core.virtual_bench.bench import Bench
from rig.core.scene.measurement_chain import Accelerometer, Hammer
from rig.core.system.structural_model import receptance

# Part of a scene file.
Settings = dict[str, Any]

# Kinds of tests. Those with dampers or joints are compared with periodic orbits or simulation, the others with closed
# form.
KINDS = (
    "random",
    "burst_random",
    "multisine",
    "impulse",
    "stepped_sine",
    "imported_stepped_sine",
    "swept_sine",
    "stepped_sine_dampers",
    "multisine_dampers",
    "swept_sine_dampers",
    "tone_dampers",
    "steps_dampers",
    "decay_dampers",
    "decay_linear",
    "stepped_sine_joints",
    "tone_finite_contact",
    "steps_finite_contact",
    "curves_close_modes",
    "multisine_close_modes",
    "stepped_sine_close_modes",
    "two_shakers_close_modes",
    "random_two_shakers",
    "multisine_two_shakers",
    "constant_response",
    "phase_resonance",
    "continuation",
    "constant_response_dampers",
    "phase_resonance_dampers",
    "continuation_dampers",
    "continuation_folds_dampers",
    "sine_control",
    "random_control",
)
# The first mode has at most this time constant, because transients must decay within seconds.
_MAX_TIME_CONSTANT_S = 1.6
# Fractions of the scenes with a fault of the measurement.
_TIGHT_RANGE_FRACTION = 0.2
_LOST_BLOCK_FRACTION = 0.15
_DOUBLE_HIT_FRACTION = 0.2
_SATURATED_FRACTION = 0.2
# Fraction of the converters that are AC coupled, and range of their corner frequencies.
_AC_COUPLED_FRACTION = 0.4
_AC_CORNERS_HZ = (0.05, 0.8)
# Draws that were added later have their own seeds, at these offsets, so that all earlier draws stay the same.
_COUPLING_SEED_OFFSET = 2_000_000
INSTRUMENT_SEED_OFFSET = 3_000_000


class Draw:
    """Random numbers and choices, all determined by a seed and a number; values have five digits."""

    def __init__(self, seed: int, number: int) -> None:
        self._random = np.random.default_rng([seed, number])

    def uniform(self, low: float, high: float) -> float:
        return float(f"{self._random.uniform(low, high):.5g}")

    def log_uniform(self, low: float, high: float) -> float:
        return float(f"{np.exp(self._random.uniform(np.log(low), np.log(high))):.5g}")

    def integer(self, low: int, high: int) -> int:
        return int(self._random.integers(low, high + 1))

    def choice(self, choices: Any) -> Any:
        return choices[self.integer(0, len(choices) - 1)]

    def chance(self, probability: float) -> bool:
        return bool(self._random.random() < probability)


def draw(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a scene for a kind of test; same seed, number and kind give the same scene."""
    random = Draw(seed, number)
    chain, natural_frequencies = draw_chain(random)
    settings: Settings = {"name": f"gauntlet {seed}/{number} {kind}", "structure": chain}
    bodies = len(chain["masses"])
    test = kind.removesuffix("_dampers").removesuffix("_joints").removeprefix("imported_")
    if kind.endswith("_dampers"):
        settings["dampers"] = _dampers(random, bodies)
    if test != "impulse":
        settings["shaker"] = _shaker(random, chain, bodies, kind)
    settings["test"] = _test(random, test, natural_frequencies, bodies, settings)
    if kind.endswith("_joints"):
        settings["joints"] = _joints(random, settings, bodies)
    settings["channels"] = _channels(random, settings, bodies)
    settings["converter"] = _converter(random, settings, natural_frequencies)
    if not any("preset" in channel.get("accelerometer", {}) for channel in settings["channels"]):
        # With sensors of a data sheet, the preset of the converter determines the coupling.
        has_preset = "preset" in settings["converter"]
        settings["converter"] |= draw_coupling(Draw(seed, number + _COUPLING_SEED_OFFSET), has_preset)
    if kind.startswith("imported_"):
        # Real converters have a filter. An import without a filter warns that the bounds exclude aliasing.
        settings["converter"] |= {"filter": "delta_sigma"}
        settings["converter"].pop("sampling", None)
    settings["recording"] = {"display": False}
    settings["seed"] = random.integer(1, 10**6)
    scene = _draw_range(random, rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"]))
    # No saturation in imported files: they do not mark overloads, and after a filter no clipped peak is flat.
    return scene if kind.startswith("imported_") else _draw_saturation(random, scene)


def draw_chain(random: Draw) -> tuple[Settings, list[float]]:
    """Draw the structure, a chain of 1 to 6 bodies; return it with its natural frequencies, Hz."""
    bodies = random.integer(1, 6)
    masses = [random.log_uniform(0.3, 3.0) for _ in range(bodies)]
    springs = np.array([random.log_uniform(0.4, 2.5) for _ in range(bodies)])
    stiffness = np.diag(springs + np.append(springs[1:], 0.0))
    stiffness -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    inverse_root_mass = 1.0 / np.sqrt(masses)
    eigenvalues = np.linalg.eigvalsh(inverse_root_mass[:, None] * stiffness * inverse_root_mass)
    natural_frequencies = np.sqrt(eigenvalues) / (2 * np.pi)
    # Scale the springs so that the first natural frequency is 8 to 25 Hz.
    factor = random.log_uniform(8.0, 25.0) / natural_frequencies[0]
    natural_frequencies = natural_frequencies * factor
    min_damping_ratio = 1.0 / (2 * np.pi * natural_frequencies[0] * _MAX_TIME_CONSTANT_S)
    damping: Settings
    damping_model = random.integer(0, 2)
    if damping_model == 0:
        damping = {"modal": random.log_uniform(max(0.003, min_damping_ratio), 0.04)}
    elif damping_model == 1:
        damping = {"modal": [random.log_uniform(max(0.003, min_damping_ratio), 0.04) for _ in range(bodies)]}
    else:
        # Proportional damping: `ratio` at the first mode, of which `fraction` is stiffness-proportional.
        ratio, fraction = random.log_uniform(max(0.005, 1.5 * min_damping_ratio), 0.03), random.uniform(0.1, 0.5)
        omega = 2 * np.pi * natural_frequencies[0]
        damping = {
            "rayleigh": {
                "alpha": float(2 * ratio * (1 - fraction) * omega),
                "beta": float(2 * ratio * fraction / omega),
            }
        }
    chain = {"masses": masses, "springs": [float(f"{k:.6g}") for k in springs * factor**2], "damping": damping}
    return chain, natural_frequencies.tolist()


def _dampers(random: Draw, bodies: int) -> list[Settings]:
    """Draw one or two dampers, with or without a ceiling."""
    dampers = []
    for body in sorted({random.integer(1, bodies) for _ in range(random.integer(1, 2))}):
        clearance = random.choice([".inf", f"{random.log_uniform(0.3, 3.0):.3g} mm"])
        dampers.append({"body": body, "mass_ratio": random.uniform(0.03, 0.12), "clearance": clearance})
    return dampers


def _joints(random: Draw, settings: Settings, bodies: int) -> list[Settings]:
    """Draw one or two joints of any kind that act near the resonance of the linear structure, but not far from it."""
    test, structure = settings["test"], {"name": "linear", "structure": settings["structure"]}
    body = settings["shaker"]["body"]
    scene = rig.load(structure | {"shaker": {"kind": "force", "body": body}})
    motion = test["force"] * receptance(scene, np.linspace(test["from"], test["to"], 500))
    places = ["ground", *range(1, bodies + 1)]
    joints = []
    for _ in range(random.integer(1, 2)):
        lower = random.integer(0, bodies - 1)
        upper = random.integer(lower + 1, bodies)
        amplitude = float(abs(motion[upper - 1] - (motion[lower - 1] if lower else 0.0)).max())
        stiffness = float(f"{settings['structure']['springs'][0] * random.log_uniform(0.1, 2.0):.4g}")
        displacement = float(f"{amplitude * random.uniform(0.2, 1.2):.4g}")
        joint: Settings = {"gap": displacement, "damping": random.log_uniform(1e-4, 1e-2) * stiffness}
        if random.chance(0.3):
            joint = {"gap": displacement, "restitution": random.uniform(0.2, 0.9)}
        if random.chance(0.5):
            joint = {"slip_force": float(f"{stiffness * displacement:.4g}")}
        joints.append({"between": [places[lower], places[upper]], "stiffness": stiffness, **joint})
    return joints


def _shaker(random: Draw, chain: Settings, bodies: int, kind: str) -> Settings:
    """Draw a shaker: an ideal force, a table or an electrodynamic shaker with a coil spring."""
    body = random.integer(1, bodies)
    shaker_kind = random.choice(["force", "table", "electrodynamic"])
    if shaker_kind == "force" or kind == "swept_sine_dampers":
        return {"kind": "force", "body": body}
    return {"kind": shaker_kind, "body": body, "spring": round(chain["springs"][0] * random.uniform(0.1, 0.6), 1)}


def _test(random: Draw, test: str, natural_frequencies: list[float], bodies: int, settings: Settings) -> Settings:
    """Draw a test from below the first mode to above a drawn mode, over 1.6 to 8 times its lowest frequency."""
    low = float(f"{natural_frequencies[0] * random.uniform(0.5, 0.8):.3g}")
    highest_mode = natural_frequencies[random.integer(0, len(natural_frequencies) - 1)]
    high = float(f"{max(min(highest_mode * random.uniform(1.1, 1.5), 8 * low), 1.6 * low):.3g}")
    level = random.log_uniform(0.2, 20.0)
    if test == "impulse":
        test_settings: Settings = {
            "kind": "impulse", "body": random.integer(1, bodies), "peak": random.log_uniform(5.0, 200.0),
            "width": random.log_uniform(2e-3, 8e-3), "repeats": random.integer(1, 6),
            "interval": random.uniform(2.0, 8.0),
        }  # fmt: skip
        if random.chance(_DOUBLE_HIT_FRACTION):
            test_settings["double_hit"] = {
                "hits": sorted({random.integer(1, test_settings["repeats"]) for _ in range(2)}),
                "after": random.uniform(12e-3, 60e-3),
                "ratio": random.uniform(0.15, 0.7),
            }
        return test_settings
    band: Settings = {"from": low, "to": high}
    has_spring = settings["shaker"]["kind"] != "force"
    # Sweeps through a spring are open loop: force control period by period takes ten times as long as all other tests.
    level_settings: Settings = {"force": level}
    if (has_spring and test == "swept_sine") or (
        has_spring and test in ("random", "burst_random", "multisine") and random.chance(0.3)
    ):
        level_settings = {"drive": _open_loop_drive(settings, level)}
    if test in ("random", "burst_random"):
        test_settings = {"kind": "random", **band, "duration": random.uniform(20.0, 60.0), **level_settings}
        if test == "burst_random":
            test_settings["burst"] = random.uniform(0.2, 0.7)
            test_settings["duration"] = random.uniform(32.0, 80.0)
        return test_settings
    if test == "multisine":
        period = random.uniform(1.0, 4.0)
        return {
            "kind": "multisine", **band, "period": period, "periods": random.integer(2, 6),
            "realisations": random.integer(1, 4), **level_settings,
        }  # fmt: skip
    if test == "stepped_sine":
        test_settings = {"kind": "stepped_sine", **band, "points": random.integer(6, 14), **level_settings}
        if "dampers" in settings:
            test_settings["direction"] = random.choice(["up", "down"])
        return test_settings
    ends = {"from": low, "to": high} if random.chance(0.7) else {"from": high, "to": low}
    return {
        "kind": "swept_sine", **ends, "duration": random.uniform(20.0, 60.0),
        "spacing": random.choice(["log", "linear"]), **level_settings,
    }  # fmt: skip


def _open_loop_drive(settings: Settings, level: float) -> float:
    """Return the drive for a force of about `level` [N]: displacement of a table [m] or voltage of an amplifier."""
    shaker = settings["shaker"]
    return float(f"{level / shaker['spring'] if shaker['kind'] == 'table' else 0.1 * level:.4g}")


def _channels(random: Draw, settings: Settings, bodies: int) -> list[Settings]:
    """Draw channels at one to three bodies and at the input, all with one kind of sensor."""
    shaker = settings.get("shaker")
    impulse = settings["test"]["kind"] == "impulse"
    measured_bodies = {random.integer(1, bodies) for _ in range(2)}
    if shaker is not None and shaker["kind"] != "force":
        measured_bodies.add(shaker["body"])
    sensors = random.choice(["ideal", "preset", "drawn", "integrated"])
    channels = [
        {"name": f"a{body}", "at": f"body {body}", **_sensor(random, sensors, impulse)}
        for body in sorted(measured_bodies)
    ]
    if impulse:
        channels.append({"name": "hammer", "at": "hammer", **_force_sensor(random, sensors)})
    elif shaker["kind"] == "force":
        channels.append({"name": "force", "at": "shaker", **_force_sensor(random, sensors)})
    else:
        channels.append({"name": "table", "at": "table", **_sensor(random, sensors, impulse)})
    return channels


def _sensor(random: Draw, sensors: str, impulse: bool) -> Settings:
    """Draw an accelerometer of a kind, with or without an integrator."""
    if sensors == "ideal":
        return {}
    if sensors == "preset":
        return {"accelerometer": {"preset": "PCB 352C33"}}
    sensor: Settings = {
        "sensitivity": random.choice(["100 mV/g", "10 mV/g", "500 mV/g"]),
        "low_cutoff": random.log_uniform(0.05, 0.8),
    }
    if random.chance(0.7):
        sensor["noise"] = f"{random.log_uniform(1.0, 100.0):.4g} ug/sqrt(Hz)"
    if random.chance(0.4):
        sensor["sensitivity_tolerance"] = random.choice([0.02, 0.05, 0.1])
    if random.chance(0.4):
        sensor["resonance"] = random.log_uniform(5e3, 50e3)
    if random.chance(0.2):
        sensor["transverse"] = 0.05
    if random.chance(0.3):
        sensor |= {"bias": f"{random.log_uniform(1e-3, 1e-1):.4g} V", "bias_settling": random.log_uniform(0.3, 3.0)}
    if sensors == "integrated" and not impulse:
        order = random.integer(1, 2)
        gain = 50.0 if order == 1 else 2000.0
        return {
            "accelerometer": sensor,
            "integrator": {"order": order, "corner": random.log_uniform(0.2, 2.0), "gain": gain, "low_cutoff": 0.2},
        }
    return {"accelerometer": sensor}


def _force_sensor(random: Draw, sensors: str) -> Settings:
    """Draw the force sensor of a hammer or shaker."""
    if sensors == "ideal":
        return {}
    if sensors == "preset":
        return {"hammer": {"preset": "PCB 086C03"}}
    sensor: Settings = {"sensitivity": random.choice(["2.25 mV/N", "11.2 mV/N", "100 mV/N"])}
    if random.chance(0.6):
        sensor["low_cutoff"] = random.log_uniform(1e-4, 0.05)
    if random.chance(0.6):
        sensor["noise"] = f"{random.log_uniform(1e-5, 1e-3):.3g} N/sqrt(Hz)"
    if random.chance(0.4):
        sensor["sensitivity_tolerance"] = random.choice([0.02, 0.05, 0.15])
    return {"hammer": sensor}


def _converter(random: Draw, settings: Settings, natural_frequencies: list[float]) -> Settings:
    """Draw a converter with at least 12 samples in a period of the highest mode, sometimes with faults."""
    min_rate = max(1024.0, 12.0 * natural_frequencies[-1])
    converter: Settings = {"rate": round(max(min_rate, random.choice([1024.0, 2048.0, 2560.0, 5120.0])), 1)}
    if settings["test"]["kind"] == "impulse":
        converter["rate"] = round(max(converter["rate"], 6.0 / settings["test"]["width"], 2048.0), 1)
    has_preset = any("preset" in channel.get("accelerometer", {}) for channel in settings["channels"])
    if has_preset or random.chance(0.3):
        converter["preset"] = "NI 9234"
        converter["rate"] = max(converter["rate"], 1652.0)
    elif random.chance(0.5):
        converter |= {
            "bits": random.choice([12, 16, 24]),
            "range": 10.0,
            "filter": random.choice(["delta_sigma", None]),
        }
        converter["noise"] = f"{random.log_uniform(0.1, 10.0):.3g} uV/sqrt(Hz)"
    if converter.get("filter") is None and "preset" not in converter and random.chance(0.2):
        converter["sampling"] = "point"
    if random.chance(0.2):
        # All channels are sampled within one sample interval.
        converter["skew"] = min(random.log_uniform(1e-6, 1e-4), 0.9 / converter["rate"] / len(settings["channels"]))
    if random.chance(0.15):
        converter["clock_error"] = random.uniform(-5e-5, 5e-5)
    if random.chance(_LOST_BLOCK_FRACTION):
        max_time_s = 30.0
        converter["dropped_blocks"] = [
            {"at": random.uniform(1.0, max_time_s), "samples": random.integer(1, 3000)}
            for _ in range(random.integer(1, 3))
        ]
    return {key: value for key, value in converter.items() if value is not None}


def draw_coupling(random: Draw, has_preset: bool) -> Settings:
    """Draw the coupling of all inputs; a converter from a preset has its own corner frequency."""
    if not random.chance(_AC_COUPLED_FRACTION):
        return {"coupling": "DC"}
    return {"coupling": "AC"} | ({} if has_preset else {"ac_corner": random.log_uniform(*_AC_CORNERS_HZ)})


def with_drawn_instruments(random: Draw, scene: rig.Scene, tolerances: bool = True) -> rig.Scene:
    """Return a scene with drawn settings of its instruments: coupling, resolution, clock error, sensor tolerances."""
    converter = scene.converter
    if converter.preset is None:
        converter = converter.replace(**draw_coupling(random, False))
    # No quantization after an integrator: it would hide every impact.
    integrated = any(channel.integrator is not None for channel in scene.channels)
    if converter.preset is None and not integrated and random.chance(0.5):
        # Readings of impacts are much larger than the linear response.
        largest_voltage = max(voltage for voltage, _ in _largest_signals(scene).values())
        input_range = float(f"{largest_voltage * random.log_uniform(10.0, 50.0):.3g}")
        converter = converter.replace(bits=random.choice([16, 24]), range=input_range)
    if random.chance(0.3):
        converter = converter.replace(clock_error=random.uniform(-5e-5, 5e-5))
    channels = []
    for channel in scene.channels:
        sensor = channel.accelerometer
        if tolerances and sensor is not None and sensor.preset is None and random.chance(0.4):
            sensor = sensor.replace(sensitivity_tolerance=random.choice([0.02, 0.05, 0.1]))
        channels.append(channel.replace(accelerometer=sensor))
    return scene.replace(converter=converter, channels=tuple(channels))


def _draw_range(random: Draw, scene: rig.Scene) -> rig.Scene:
    """Return a scene with a drawn input range of the converter: mostly with margin, sometimes too small."""
    if "bits" not in scene.converter.model_fields_set and random.chance(0.3):
        return scene
    margin = random.log_uniform(0.15, 0.8) if random.chance(_TIGHT_RANGE_FRACTION) else random.log_uniform(1.5, 50.0)
    largest_voltage = max(voltage for voltage, _ in _largest_signals(scene).values())
    input_range = float(f"{max(largest_voltage * margin, 1e-6):.3g}")
    return scene.replace(converter=scene.converter.replace(range=input_range))


def _draw_saturation(random: Draw, scene: rig.Scene) -> rig.Scene:
    """Return a scene in which a sensor may saturate, sometimes with a slow recovery from overload."""
    if not random.chance(_SATURATED_FRACTION):
        return scene
    saturating = random.choice([channel.name for channel in scene.channels])
    _, largest_input = _largest_signals(scene)[saturating]
    limit = {"saturation": float(f"{largest_input * random.log_uniform(0.2, 2.0):.3g}")}
    channels = []
    for channel in scene.channels:
        if channel.name == saturating and channel.measures_force:
            channel = channel.replace(hammer=(channel.hammer or Hammer()).replace(**limit))
        elif channel.name == saturating:
            if random.chance(0.3):
                limit["overload_recovery"] = random.log_uniform(2e-3, 0.2)
            channel = channel.replace(accelerometer=(channel.accelerometer or Accelerometer()).replace(**limit))
        channels.append(channel)
    return scene.replace(channels=tuple(channels))


def _largest_signals(scene: rig.Scene) -> dict[str, tuple[float, float]]:
    """Estimate for each channel the largest voltage and the largest input of its sensor (SI), without dampers."""
    test, is_single_tone = scene.test, scene.test.kind in ("sine", "stepped_sine", "swept_sine")
    if test.kind == "sine":
        band, level = np.array([test.frequency]), test.force
    elif test.kind == "impulse":
        band, level = np.linspace(2.0, 1.0 / test.width, 2000), test.peak
    else:
        band = np.linspace(min(test.from_, test.to), max(test.from_, test.to), 2000)
        level = test.force if test.force is not None else 1.0
        level = level[0] if isinstance(level, tuple) else level
    response = receptance(scene, band)
    largest = {}
    for info in Bench(scene).channels:
        order = {"displacement": 0, "velocity": 1, "acceleration": 2}.get(info.quantity, 0)
        motion = np.ones(band.size)
        if info.at.startswith("body"):
            motion = abs(response[int(info.at.split()[1]) - 1])
        elif info.at == "table":
            motion = 1.0 / scene.shaker.spring + abs(response[scene.shaker.bodies[0] - 1])
        readings = abs(info.response(band)) * info.sensitivity * (2 * np.pi * band) ** order * motion
        inputs = motion if info.quantity == "force" else (2 * np.pi * band) ** 2 * motion
        if test.kind == "impulse" and info.quantity != "force":
            # The pulse excites all modes together.
            readings, inputs = 4.0 * test.width * readings, 4.0 * test.width * inputs
        # A single tone is largest at a resonance; other signals are taken as three times their RMS value.
        largest[info.name] = tuple(
            float(level * (curve.max() if is_single_tone else 3.0 * np.sqrt(np.mean(curve**2))))
            for curve in (readings, inputs)
        )
    return largest
