"""Random scenes of tests with profile control: chains on a base, a force shaker or an electrodynamic shaker."""

import numpy as np
import yaml

import rig
from daq.core.excitation.profiles.profile_checks import check_sweep
from daq.core.virtual_bench.bench import Bench
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import riding_response
from tests.gauntlet.scenes import Draw, Settings, draw_chain

# Kinds of tests.
SINE, NOISE = "sine_control", "random_control"
# The check before the test expects this deviation, dB.
_EXPECTED_DB = 0.9
_MAX_DURATION_S = 600.0
# Ratio of the ends of the sweep to its center.
_HALF_BAND = 1.12
_AVERAGES = 20
# Limit of a channel, relative to its largest motion without the limit.
_LIMIT_RATIO = 0.5


def draw_profile_control(seed: int, number: int, kind: str) -> rig.Scene:
    """Draw a chain of one to four bodies with a controlled channel, and in half of the scenes a limit."""
    random = Draw(seed, number)
    chain, natural_frequencies = draw_chain(random)
    while len(chain["masses"]) > 4:
        chain, natural_frequencies = draw_chain(random)
    bodies, body = len(chain["masses"]), random.integer(1, len(chain["masses"]))
    shaker: Settings = {"kind": random.choice(["base", "force", "electrodynamic"])}
    if shaker["kind"] != "base":
        shaker |= {"body": body}
    if shaker["kind"] == "electrodynamic":
        shaker |= {"spring": round(chain["springs"][0] * random.uniform(0.1, 0.6), 1)}
    low = float(f"{0.7 * natural_frequencies[0]:.3g}")
    high = float(f"{min(1.4 * natural_frequencies[-1], 8.0 * low):.3g}")
    control, limited = "table" if shaker["kind"] == "base" else f"a{body}", f"a{random.integer(1, bodies)}"
    sensor = {"sensitivity": "100 mV/g", "noise": f"{random.log_uniform(5.0, 50.0):.3g} ug/sqrt(Hz)"}
    channels = [{"name": f"a{k}", "at": f"body {k}", "accelerometer": sensor} for k in range(1, bodies + 1)]
    if shaker["kind"] == "base":
        channels.append({"name": "table", "at": "table", "accelerometer": sensor})
    else:
        channels.append({"name": "force", "at": "shaker", "hammer": {"sensitivity": "100 mV/N"}})
    level = random.log_uniform(0.3, 2.0)
    if kind == SINE:
        profile: Settings = {"frequencies": [low, high], "acceleration": [level, level * random.uniform(0.5, 2.0)]}
        test: Settings = {"kind": SINE, "from": low, "to": high, "duration": 60.0, "tolerance": 1.0}
    else:
        profile = {"frequencies": [low, high], "density": [1e-2 * level, 1e-2 * level * random.uniform(0.5, 2.0)]}
        test = {"kind": NOISE, "averages": _AVERAGES, "tolerance": 1.5, "lines": random.integer(100, 400)}
        # After the loop has settled, at least 20 averages.
        test["duration"] = float(f"{4 * _AVERAGES * test['lines'] / (high - low):.4g}")
    test |= {"profile": profile, "control": {"channels": [control]}}
    settings: Settings = {
        "name": f"gauntlet {seed}/{number} {kind}",
        "structure": chain,
        "shaker": shaker,
        "test": test,
        "channels": channels,
        "converter": {"rate": random.choice([1024.0, 2048.0]), "bits": 24, "range": 10.0},
        "recording": {"display": False},
        "seed": random.integer(1, 10**6),
    }
    scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    if limited != control and random.chance(0.5):
        key, power = ("acceleration", 1) if kind == SINE else ("density", 2)
        largest = _LIMIT_RATIO * _largest_motion(scene, control, limited, power)
        test["limits"] = [{"channel": limited, "frequencies": [low, high], key: [largest, largest]}]
        scene = rig.loads(yaml.safe_dump(settings, sort_keys=False), where=settings["name"])
    return _slow_enough(scene) if kind == SINE else scene


def _slow_enough(scene: rig.Scene) -> rig.Scene:
    """Return the scene with a sweep of a sixth of an octave or more about the fastest change of the drive."""
    channels, whole = Bench(scene).channels, scene.test
    center = check_sweep(whole, scene, channels).frequency
    ends = {"from_": max(center / _HALF_BAND, whole.from_), "to": min(center * _HALF_BAND, whole.to)}
    part = scene.test.replace(**ends)
    deviation = check_sweep(part, scene, channels).deviation
    duration = part.duration * deviation / _EXPECTED_DB
    return scene.replace(test=part.replace(duration=float(f"{min(max(duration, 20.0), _MAX_DURATION_S):.4g}")))


def _largest_motion(scene: rig.Scene, control: str, limited: str, power: int) -> float:
    """Return the largest amplitude or density of a channel while the control is at the profile."""
    system, frequency = assemble(scene), np.geomspace(*scene.test.band, 500)
    places = {info.name: info.at for info in Bench(scene).channels}
    states = abs(riding_response(system, scene.at_driven("shaker"), 2.0 * np.pi * frequency))
    of_control, of_limited = (states[system.points.index(places[name])] for name in (control, limited))
    return float(np.max((of_limited / of_control) ** power * scene.test.profile.at(frequency)))
