"""Random scene files with invalid or extreme entries, and commands on them."""

import random
from collections.abc import Iterator
from typing import Any

import yaml

# Control sequences of a terminal: color and window title.
ESCAPE = "\x1b[31mred\x1b]0;title\x07"
# Markup of HTML, rich and Markdown.
MARKUP = "<script>alert(1)</script> [bold]x[/bold] **b** `c` |d| ![i](http://x)"
UNUSUAL_TEXTS = (
    ESCAPE,
    MARKUP,
    "",
    " ",
    "\u202e\u200b\ufeff",
    "x" * 60_000,
    "../../etc/passwd",
    "a\nb",
    "\u0000",
    "%s{0}$(x)",
)
UNUSUAL_NUMBERS = (
    0,
    -1,
    1,
    2**31,
    2**63,
    10**300,
    -(10**300),
    1e-308,
    5e-324,
    1e308,
    -1e308,
    1e9,
    1e12,
    1e-12,
    1e20,
    1e-20,
    1e100,
    float("nan"),
    float("inf"),
    float("-inf"),
)
UNUSUAL_VALUES: tuple[Any, ...] = (None, True, [], {}, [[]], [None], {"a": {"b": []}}, [1, "x"], ["1 kg"] * 1000)
UNITS = ("Hz", "s", "kg", "N", "V", "m", "mm", "%", "kN/m", "rad/s", "mV/g", "bit", "", "parsec", "ug/sqrt(Hz)")

# A body on a shaker table, and a body with a damper that a force drives: for tests that control or follow the motion.
_TABLE: dict[str, Any] = {
    "structure": {"masses": ["12 kg"], "springs": ["240 kN/m"], "damping": {"modal": "2 %"}},
    "shaker": {"kind": "base", "output": {"range": "10 V", "bits": 16}},
    "channels": [
        {"name": "table", "at": "table", "accelerometer": {"sensitivity": "100 mV/g"}},
        {"name": "body1", "at": "body 1", "accelerometer": {"sensitivity": "100 mV/g"}},
    ],
    "converter": {"rate": "1024 Hz", "bits": 24, "range": "5 V"},
}
_FORCED: dict[str, Any] = {
    "structure": {"masses": ["1 kg"], "springs": ["100 kN/m"], "damping": {"modal": "2 %"}},
    "dampers": [{"body": 1, "mass_ratio": "5 %", "clearance": "1 mm"}],
    "shaker": {"kind": "force", "body": 1},
    "channels": [
        {
            "name": "body1",
            "at": "body 1",
            "accelerometer": {"sensitivity": "100 mV/g", "noise": "20 ug/sqrt(Hz)"},
            "integrator": {"order": 2, "corner": "1 Hz", "gain": 1000},
        },
        {"name": "force", "at": "shaker"},
    ],
    "converter": {"rate": "1024 Hz", "bits": 24, "range": "5 V"},
}
# Valid scenes, from which the invalid ones are made.
VALID_SCENES: tuple[dict[str, Any], ...] = (
    {
        "structure": {
            "masses": ["0.74 kg", "0.71 kg"],
            "springs": ["24.3 kN/m", "21.8 kN/m"],
            "damping": {"modal": "0.5 %"},
        },
        "dampers": [
            {"body": 1, "mass_ratio": "10 %", "clearance": ".inf"},
            {"body": 2, "mass": "70 g", "clearance": "1 mm", "restitution": 0.3},
        ],
        "shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"},
        "test": {
            "kind": "stepped_sine",
            "from": "20 Hz",
            "to": "25 Hz",
            "points": 2,
            "force": "2 N",
            "settle": {"longest": "0.5 s"},
            "measure": {"periods": 3},
        },
        "channels": [
            {
                "name": "body1",
                "at": "body 1",
                "accelerometer": {
                    "sensitivity": "100 mV/g",
                    "noise": "20 ug/sqrt(Hz)",
                    "resonance": "30 kHz",
                    "low_cutoff": "0.5 Hz",
                },
                "integrator": {"order": 2, "corner": "1 Hz"},
            },
            {"name": "table", "at": "table", "accelerometer": {"sensitivity": "100 mV/g"}},
        ],
        "converter": {"rate": "2048 Hz", "bits": 24, "range": "5 V"},
        "recording": {"display": True, "truth": True},
        "gravity": "9.81 m/s^2",
        "seed": 1,
        "name": "two bodies",
    },
    {
        "structure": {
            "masses": ["0.7 kg", "0.7 kg", "0.6 kg"],
            "springs": ["24 kN/m", "22 kN/m", "20 kN/m"],
            "damping": {"rayleigh": {"alpha": "0.1 1/s", "beta": "1e-5 s"}},
        },
        "test": {"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "repeats": 2, "interval": "0.5 s"},
        "seed": 3,
    },
    {
        "structure": {"masses": [1.0], "springs": [4e4], "damping": {"dashpots": [1.0]}},
        "dampers": [{"body": 1, "mass_ratio": 0.1, "clearance": 1e-3}],
        "shaker": {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m"},
        "test": {"kind": "random", "from": "10 Hz", "to": "100 Hz", "duration": "1 s", "drive": "0.1 V"},
        "converter": {"rate": "1000 Hz"},
    },
    {
        "structure": {"masses": [1.0, 0.5], "springs": [4e4, 2e4]},
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "swept_sine", "from": "10 Hz", "to": "30 Hz", "duration": "1 s", "force": "1 N"},
        "converter": {"preset": "NI 9234", "rate": "51200 Hz", "filter": "delta_sigma"},
    },
    {
        "structure": {"masses": [1.0, 0.5], "springs": [4e4, 2e4]},
        "test": {"kind": "free", "displacement": ["1 mm", "0 mm"], "duration": "0.5 s"},
        "dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": 1e-3, "locked": True}],
    },
    {
        "structure": {"masses": [1.0, 0.5], "springs": [4e4, 2e4]},
        "shaker": {"kind": "force", "body": 1},
        "test": {
            "kind": "multisine",
            "from": "10 Hz",
            "to": "30 Hz",
            "lines": 5,
            "periods": 2,
            "realisations": 1,
            "force": "1 N",
        },
    },
    {
        **_TABLE,
        "test": {
            "kind": "sine_control",
            "from": "10 Hz",
            "to": "15 Hz",
            "duration": "10 s",
            "profile": {"frequencies": ["10 Hz", "15 Hz"], "acceleration": ["0.1 g", "0.3 g"]},
            "control": {"channels": ["table"]},
        },
    },
    {
        **_TABLE,
        "test": {
            "kind": "random_control",
            "profile": {"frequencies": ["20 Hz", "100 Hz"], "density": ["0.001 g^2/Hz", "0.001 g^2/Hz"]},
            "control": {"channels": ["table"]},
            "lines": 60,
            "duration": "5 s",
        },
    },
    {
        **_TABLE,
        "test": {
            "kind": "shock",
            "half_sine": {"peak": "5 g", "width": "11 ms"},
            "control": "table",
            "interval": "1 s",
        },
    },
    {
        **_FORCED,
        "test": {
            "kind": "constant_response",
            "from": "49 Hz",
            "to": "50 Hz",
            "points": 2,
            "at": "body 1",
            "displacement": ["0.2 mm"],
        },
    },
    {
        **_FORCED,
        "test": {
            "kind": "phase_resonance",
            "frequency": "49 Hz",
            "from": "45 Hz",
            "to": "53 Hz",
            "at": "body 1",
            "force": ["1 N"],
        },
    },
    {**_FORCED, "test": {"kind": "continuation", "from": "51 Hz", "to": "49.5 Hz", "at": "body 1", "force": ["1 N"]}},
)
# Scenes with recordings that are damaged, or whose recording is interrupted: all kinds of procedures.
RECORDED_SCENES = (0, 1, 3, *range(6, len(VALID_SCENES)))


def valid_scene(rng: random.Random) -> str:
    """Return a valid scene file."""
    return yaml.safe_dump(rng.choice(VALID_SCENES), sort_keys=False)


def invalid_scene(rng: random.Random) -> str:
    """Return a scene file with one to three invalid or extreme entries."""
    content = _copy(rng.choice(VALID_SCENES))
    if rng.random() < 0.08:
        return _not_a_scene(rng)
    if rng.random() < 0.1:
        _enlarge(content, rng)
    else:
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            _replace_entry(content, rng)
    return yaml.safe_dump(content, allow_unicode=True, sort_keys=False)


def _copy(content: Any) -> Any:
    return yaml.safe_load(yaml.safe_dump(content))


def _not_a_scene(rng: random.Random) -> str:
    """Return a text that is not YAML, or YAML that is not a scene."""
    return rng.choice(
        (
            "",
            "[]",
            "a",
            "{",
            "- - - -" * 1000,
            "[" * 5000,
            "a: &a [*a]",
            "&a [" + "*a," * 10 + "]",
            "!!python/object:os.x {}",
            "a: 1\na: 2",
            "\t",
            "? ? ?",
            "structure: " + "{a: " * 900 + "}" * 900,
            "x: !!binary aaaa",
            "1e999: 1",
            "&b {"
            + "".join(f"k{i}: &x{i} [*x{i - 1}, *x{i - 1}], " if i else "k0: &x0 [1], " for i in range(40))
            + "}",
        )
    )


def key_paths(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys that lead to each entry of nested dictionaries and lists."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from key_paths(value, (*path, key))


def _replace_entry(content: Any, rng: random.Random) -> None:
    """Replace or remove one entry."""
    *path, key = rng.choice(list(key_paths(content)))
    for part in path:
        content = content[part]
    if rng.random() < 0.1 and isinstance(content, dict):
        del content[key]
        return
    content[key] = _unusual_value(content[key], rng)


def _unusual_value(value: Any, rng: random.Random) -> Any:
    """Draw an unusual number with the unit of a value, an unusual text, or a value of a different type."""
    kind = rng.random()
    if kind < 0.55:
        number = rng.choice(UNUSUAL_NUMBERS)
        unit = str(value).split(" ", 1)[-1] if " " in str(value) else ""
        unit = rng.choice(UNITS) if rng.random() < 0.2 else unit
        return f"{number!r} {unit}".strip() if unit else number
    if kind < 0.75:
        return rng.choice(UNUSUAL_TEXTS)
    return _copy(rng.choice(UNUSUAL_VALUES))


def _enlarge(content: Any, rng: random.Random) -> None:
    """Make one part of the scene very large."""
    count = rng.choice((300, 2_000, 20_000, 100_000, 1_000_000))
    part = rng.choice(("bodies", "channels", "dampers", "steps"))
    if part == "bodies":
        content["structure"] = {"masses": [1.0] * count, "springs": [1e4] * count}
    elif part == "channels":
        content["channels"] = [{"name": f"c{i}", "at": "body 1"} for i in range(min(count, 100_000))]
    elif part == "dampers":
        content["dampers"] = [{"body": 1, "mass": 0.01, "clearance": 1e-3} for _ in range(min(count, 20_000))]
    else:
        content["test"] = {"kind": "stepped_sine", "from": 10, "to": 20, "points": min(count, 100_000), "force": 1}
        content["shaker"] = {"kind": "force", "body": 1}


def scene_command(path: str, rng: random.Random) -> list[str]:
    """Return a command on a scene, often with an invalid option."""
    unusual = rng.choice(UNUSUAL_NUMBERS)
    choose = lambda *options: list(rng.choice(options))  # noqa: E731
    commands: dict[str, list[str]] = {
        "explain": ["rig", "explain", path],
        "simulate": [
            "rig",
            "simulate",
            path,
            *choose(
                ("--duration", "0.05 s"),
                ("--duration", f"{unusual} s"),
                ("--rate", f"{unusual} Hz"),
                ("--frequency", f"{unusual} Hz", "--duration", "0.05 s"),
                (),
            ),
        ],
        "response": [
            "rig",
            "response",
            path,
            *choose(
                ("--points", "2"),
                ("--from", "20 Hz", "--to", f"{unusual} Hz"),
                ("--points", str(unusual)),
                ("--direction", "\x1b[3m"),
                (),
            ),
        ],
        "map": [
            "rig",
            "map",
            path,
            "--rows",
            "2",
            "--points",
            "2",
            *choose((), ("--least", f"{unusual} N"), ("--over", "x"), ("--rows", "1000000000")),
        ],
        "record": [
            "daq",
            "record",
            path,
            "-o",
            "r.mcap",
            "--overwrite",
            *choose((), ("--block", str(unusual)), ("--block", "7")),
        ],
    }
    return commands[rng.choices(list(commands), weights=(2, 3, 2, 1, 4))[0]]


def rare_command(path: str, rng: random.Random) -> list[str]:
    """Return a rarely used command, often with an unusual number; its folder has the scene, r.mcap, x.csv and c.py."""
    unusual, text = rng.choice(UNUSUAL_NUMBERS), rng.choice(UNUSUAL_TEXTS).replace("\0", "")
    commands = (
        f"rig cost {path} --periods 2",
        f"rig cost {path} --frequency {unusual}Hz",
        f"rig design {path} --levels {unusual}N,1N",
        f"rig design {path} --budget {unusual}kg --dampers 2",
        f"rig design {path} --budget {unusual}kg --bodies {unusual} --band 20Hz,{unusual}Hz",
        f"rig design {path} --clearance {unusual}m,1mm --damping-off {unusual}",
        f"rig simulate {path} --duration 0.05s --set seed={unusual} --set structure.masses[1]={unusual}kg",
        f"rig grains {path} --points 2 --periods 1",
        f"analysis cost {path} --frequency {unusual}",
        f"analysis fit r.mcap {path} --overwrite",
        f"analysis fit r.mcap {path} --free structure.masses[{unusual}]",
        f"daq run --scene {path} --clock fast c.py",
        f"daq import x.csv --scene {path} --from {unusual} -o i.mcap",
        f"daq serve {path} --port {unusual}",
    )
    words = rng.choice(commands).split()
    if rng.random() < 0.1:
        words = [*rng.choice((("rig", "help"), ("rig", "presets"), ("rig", "scenes"))), text]
    return words
