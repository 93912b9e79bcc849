"""Whether two versions give the same bytes: `python -m tests.same_results [--engine] A B`.

A and B are commits, folders of code, or JSON files with results. `python -m tests.same_results A > a.json` stores the
results of a version. Compared are recordings, arrays of rig, printed texts, messages of bad scenes, and files of
`analysis`, each by its SHA-256 digest. `--engine` compares only motions that the engine computes
(`tests.engine_results`), which takes a minute. The exit code is 1 if a result differs.
"""

import contextlib
import hashlib
import io
import json
import os
import runpy
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from difflib import unified_diff
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from tests.benchmarks.checkouts import temporary_checkout

# Changes that shorten the tests of the bundled scenes, by kind of test.
SHORTENED: dict[str, dict[str, Any]] = {
    "stepped_sine": {"test.points": 2, "test.settle.longest": "3 s"},
    "impulse": {"test.repeats": 1, "test.interval": "1 s"},
    "sine": {"test.duration": "0.3 s"},
    "constant_response": {"test.displacement": ["0.2 mm"], "test.points": 2},
    "phase_resonance": {"test.force": ["1 N"]},
    "continuation": {"test.force": "0.9 N", "test.from": "51 Hz", "test.to": "50 Hz"},
    "random_control": {"test.duration": "10 s", "test.ramp": [-6.0]},
    "shock": {"test.repeats": 1},
    "sine_control": {"test.duration": "30 s"},
}

BENCH: dict[str, Any] = {
    "structure": {"masses": [0.74, 0.71, 0.64], "springs": [24300, 21800, 19800], "damping": {"modal": 0.005}},
    "dampers": [{"body": 2, "mass_ratio": 0.06, "clearance": "0.98 mm"}],
    "shaker": {"kind": "electrodynamic", "body": 1, "spring": "6.6 kN/m"},
    "converter": {"rate": 2000},
}
TABLE = {"kind": "table", "body": 1, "spring": "6.6 kN/m"}
FORCE = {"kind": "force", "body": 1}
BAND = {"from": "10 Hz", "to": "60 Hz"}
NOISE = {"kind": "random", **BAND, "duration": "4 s"}
MULTISINE = {"kind": "multisine", **BAND, "lines": 20, "periods": 2, "realisations": 2}
SWEEP = {"kind": "swept_sine", **BAND, "duration": "4 s"}
STEPS = {"kind": "stepped_sine", "frequencies": ["12 Hz", "34 Hz"], "settle": {"longest": "2 s"}}
HIT = {"kind": "impulse", "body": 1, "peak": "40 N", "width": "4 ms", "repeats": 2, "interval": "1.5 s"}
CHANNELS = [{"name": f"body{n}", "at": f"body {n}"} for n in (1, 2, 3)] + [{"name": "table", "at": "table"}]

# Scenes that differ from `BENCH`.
SMALL: dict[str, dict[str, Any]] = {
    "sweep": {"test": {**SWEEP, "drive": "0.5 V"}},
    "sweep-controlled": {"test": {**SWEEP, "force": "1 N"}},
    "sweep-down": {"shaker": FORCE, "test": {**SWEEP, "from": "60 Hz", "to": "9 Hz", "spacing": "linear", "force": 2}},
    "steps": {"shaker": FORCE, "test": {**STEPS, "force": [1, 3], "direction": "both"}},
    "steps-table": {"shaker": TABLE, "test": {**STEPS, "drive": "0.1 mm"}},
    "sine": {"test": {"kind": "sine", "frequency": "33 Hz", "force": "1 N"}},
    "random": {"test": {**NOISE, "force": "0.5 N"}},
    "linear": {"dampers": None, "test": {**NOISE, "force": "0.5 N"}},
    "burst": {"test": {**NOISE, "drive": "0.5 V", "burst": 0.5}},
    "multisine": {"test": {**MULTISINE, "force": "0.5 N"}},
    "multisine-period": {"shaker": TABLE, "test": {**MULTISINE, "lines": None, "period": "0.8 s", "drive": "0.1 mm"}},
    "two-shakers": {"shaker": [FORCE, FORCE | {"body": 3}], "test": {**NOISE, "force": 0.5, "shaker": 2, "also": [1]}},
    "free": {"test": {"kind": "free", "mode": 1, "amplitude": "2 mm", "duration": "2 s"}},
    "free-velocity": {"test": {"kind": "free", "displacement": [0, 0, 1e-3], "velocity": [0.1, 0, 0], "duration": 1}},
    "hits": {"shaker": None, "test": {**HIT}},
    "double-hit": {"shaker": FORCE, "test": {**HIT, "double_hit": {"hits": [2]}}},
    "table-drive": {"shaker": TABLE, "test": {"kind": "sine", "frequency": "33 Hz", "drive": "0.1 mm"}},
    "table-force": {"shaker": TABLE, "test": {**STEPS, "force": "1 N"}},
    "current": {
        "shaker": {**BENCH["shaker"], "amplifier": {"mode": "current", "gain": "2 A/V", "limit": "3 A"}},
        "test": {**STEPS, "drive": "0.2 V"},
    },
    "finite-contact": {
        "dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": ".inf", "contact": {"duration": "5 ms"}}],
        "test": {"kind": "sine", "frequency": "33 Hz", "drive": "1 V", "duration": "1 s"},
    },
    "24-bits": {
        "channels": [{**channel, "accelerometer": {"sensitivity": "100 mV/g"}} for channel in CHANNELS],
        "converter": {"preset": "NI 9234"},
        "test": {**STEPS, "frequencies": ["34 Hz"], "force": "1 N"},
    },
}  # fmt: skip

# Changes of `BENCH` with the test `STEPS` that are rejected.
BAD: tuple[dict[str, Any], ...] = (
    {"test.kind": "chirp"},
    {"test.force": None},
    {"test.drive": "1 V"},
    {"test.shaker": 2},
    {"shaker": None},
    {"shaker": FORCE, "test.force": None, "test.drive": "1 N"},
    {"shaker": [FORCE, FORCE]},
    {"shaker": [FORCE, FORCE], "test": {**NOISE, "force": 1, "shaker": 1, "also": [1]}},
    {"shaker": [FORCE, FORCE], "test": {**NOISE, "force": 1, "shaker": 1, "also": [3]}},
    {"test.frequencies": ["12 Hz", "2 kHz"]},
    {"test.frequencies": ["34 Hz", "12 Hz"]},
    {"test": {**SWEEP, "force": 1, "to": "2 kHz"}},
    {"test": {**SWEEP, "force": 1, "from": "2 kHz"}},
    {"test": {**NOISE, "force": 1, "from": "70 Hz"}},
    {"test": {"kind": "sine", "frequency": "1000 Hz", "force": 1}},
    {"test": {**HIT, "body": 4}},
    {"test": {**HIT, "width": "2 s"}},
    {"test": {"kind": "free", "displacement": [0, 0]}},
    {"test": {"kind": "free", "mode": 4, "amplitude": "1 mm"}},
    {"test": {"kind": "free"}},
    {"channels": [{"name": "hammer", "at": "hammer"}]},
    {"test": None, "channels": [{"name": "hammer", "at": "hammer"}]},
    {"shaker": FORCE, "channels": CHANNELS},
    {"channels": [{"name": "force", "at": "shaker"}]},
    {"shaker": FORCE, "test": HIT, "channels": [{"name": "force", "at": "shaker"}]},
    {"shaker": None, "test": HIT, "channels": [{"name": "drive", "at": "drive"}]},
    {"channels": CHANNELS[1:3]},
)

# Commands that analyze a recording, by the name of its scene.
ANALYSES: dict[str, tuple[str, ...]] = {
    "steps": ("frf", "dampers"),
    "sweep-controlled": ("frf", "modes"),
    "table-force": ("frf", "frf --reference table"),
    "random": ("frf", "frf --estimator H1", "modes"),
    "burst": ("frf",),
    "multisine": ("frf",),
    "two-shakers": ("frf",),
    "double-hit": ("frf", "decay"),
    "hits": ("frf --motion velocity", "modes", "decay"),
    "free": ("decay", "frf", "modes"),
    "table-drive": ("frf", "frf --reference table", "report"),
}


# Scenes whose recordings are exported and imported again.
IMPORTED = ("steps", "table-force", "sine", "sweep", "linear", "double-hit", "free")


def bench_scenes() -> Iterator[tuple[str, Any]]:
    """Yield the bundled scenes with shortened tests, and the small scenes."""
    import rig
    from rig.core.scene.scene_files import bundled_scenes

    for name in bundled_scenes():
        test = rig.load(name).test
        yield name, rig.load(name, {} if test is None else SHORTENED[test.kind])
    for name, changes in SMALL.items():
        yield name, rig.load(_merged(BENCH, {"name": name, **changes}))


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in (base | changes).items() if value is not None}


def _bad_scene(changes: dict[str, Any]) -> str:
    """Load a scene with a mistake; keys such as test.force change one setting of the test."""
    import rig

    test = STEPS | {"force": 1.0} | {key.removeprefix("test."): changes[key] for key in changes if "." in key}
    sections = {key: value for key, value in changes.items() if "." not in key}
    return rig.load(_merged(BENCH, {"test": _merged(test, {}), **sections})).to_si_yaml()


def _arrays(scene: Any) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield simulation, steady response, orbits and map of a scene, as functions that compute them."""
    import rig

    frequencies = [11.0, 33.5, 50.0]
    run = ("displacement", "velocity", "acceleration", "gap", "events", "energy")
    yield "simulation", lambda: [getattr(rig.simulate(scene, 0.5, rate=2000), name) for name in run]
    yield "steady response", lambda: rig.frequency_response(scene, frequencies).compliance
    yield "orbits", lambda: rig.orbit_response(scene, frequencies[2:]).compliance
    yield "map", lambda: list(rig.map_motion(scene, None, [1.0], frequencies[1:2]).columns().values())


def _printed(command: str) -> str:
    """Return what a command prints, also as an error."""
    text, previous = io.StringIO(), sys.argv
    program, *arguments = command.split()
    sys.argv = [program, *arguments]
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text), contextlib.suppress(SystemExit):
        import_module(f"{program}.commands.cli").main()
    sys.argv = previous
    return text.getvalue()


def _attempt(compute: Callable[[], Any]) -> Any:
    """Return a result, or the error's text."""
    try:
        return compute()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _record(name: str, scene: Any) -> Iterator[tuple[str, Any]]:
    """Record a scene, import the recording again, and analyze it; files are written into the current folder."""
    import daq

    recording = f"{name}.mcap"
    yield "recording", _attempt(lambda: daq.record(scene, recording).read_bytes())
    for command in ("daq info", *(f"analysis {each}" for each in ANALYSES.get(name, ()))):
        program, subcommand, *options = command.split()
        output = [] if program == "daq" else ["-o", f"{name}-{'-'.join((subcommand, *options))}"]
        yield command, _printed(" ".join((program, subcommand, recording, *options, *output)))
    if name in IMPORTED:
        Path(f"{name}.yaml").write_text(scene.to_si_yaml(), encoding="utf-8")
        yield "export", _printed(f"analysis export {recording} -o {name}.npz")
        yield "import", _printed(f"daq import {name}.npz --scene {name}.yaml -o {name}-imported.mcap")


def _foresight(scene: Any) -> str:
    import daq

    foresight = daq.foresee(scene)
    return f"{foresight}\n{foresight.columns()}"


def _engine_results() -> Iterator[tuple[str, Any]]:
    """Yield names and motions of the engine of the version that Python imports."""
    # The script of this checkout, whichever version is imported.
    script = runpy.run_path(str(Path(__file__).with_name("engine_results.py")))
    for name, compute in script["engine_results"]():
        yield name, _attempt(compute)


def _all_results() -> Iterator[tuple[str, Any]]:
    """Yield names and results of the version that Python imports."""
    import rig

    yield from _engine_results()
    keys = ("kind", "force", "drive", "from", "frequency", "duration", "body", "also", "settle", "double_hit")
    helps = (f"rig help {key}" for key in ("test", "shaker", *(f"test.{key}" for key in keys)))
    for command in ("rig schema", "rig schema --explain", "rig scenes", *helps):
        yield command, _printed(command)
    for number, changes in enumerate(BAD):
        yield f"bad scene {number}", _attempt(partial(_bad_scene, changes))
    for name, scene in bench_scenes():
        yield f"{name}: scene", scene.to_si_yaml()
        yield f"{name}: explanation", str(rig.explain(scene))
        yield f"{name}: foresight", _attempt(partial(_foresight, scene))
        for kind, compute in _arrays(scene):
            if name in SMALL or name.startswith("reference"):
                yield f"{name}: {kind}", _attempt(compute)
        for kind, result in _record(name, scene):
            yield f"{name}: {kind}", result
    command = "analysis fit linear.mcap linear.yaml --free structure.damping -o fitted.yaml"
    yield command, _printed(command)
    for path in sorted(Path().rglob("*")):
        if path.is_file() and path.suffix != ".png":
            yield f"file {path}", path.read_bytes()


def _digest(result: Any) -> str:
    import numpy as np

    if isinstance(result, list):
        return "+".join(map(_digest, result))
    if isinstance(result, np.ndarray) and result.dtype != object:
        result = result.tobytes()
    return hashlib.sha256(result if isinstance(result, bytes) else repr(result).encode()).hexdigest()[:16]


def collect(results_of_version: Iterator[tuple[str, Any]], target: Path) -> None:
    """Compute results and write them as JSON; texts are stored as they are."""
    results = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, result in results_of_version:
            results[name] = result if isinstance(result, str) else _digest(result)
    target.write_text(json.dumps(results, indent=1), encoding="utf-8")


def results_of(version: str, collect_option: str) -> dict[str, str]:
    """Return the results of a commit, a folder of code or a JSON file; `collect_option`: for the run that does it."""
    if version.endswith(".json"):
        return dict(json.loads(Path(version).read_text(encoding="utf-8")))
    with tempfile.TemporaryDirectory() as directory, contextlib.ExitStack() as stack:
        code, target = Path(version).absolute(), Path(directory) / "results.json"
        if not code.is_dir():
            code = stack.enter_context(temporary_checkout(version, Path(directory) / "code"))
        command = [sys.executable, "-P", __file__, collect_option, str(target)]
        # One fixed folder and width, because both appear in printed texts.
        environment = {**os.environ, "PYTHONPATH": str(code), "COLUMNS": "100"}
        subprocess.run(command, check=True, cwd=code, env=environment)
        return dict(json.loads(target.read_text(encoding="utf-8")))


def main(arguments: list[str]) -> int:
    """Compare two versions, or print the results of one; return the exit code."""
    collections = {"--collect": _all_results, "--collect-engine": _engine_results}
    if arguments[0] in collections:
        collect(collections[arguments[0]](), Path(arguments[1]))
        return 0
    collect_option = "--collect"
    if arguments[0] == "--engine":
        collect_option, arguments = "--collect-engine", arguments[1:]
    versions = [results_of(version, collect_option) for version in arguments]
    if len(versions) == 1:
        print(json.dumps(versions[0], indent=1))
        return 0
    first, second = versions
    different = [name for name in (first | second) if first.get(name) != second.get(name)]
    for name in different:
        texts = (results.get(name, "(absent)").splitlines() for results in versions)
        print(name, *unified_diff(*texts, *arguments, n=0, lineterm=""), sep="\n  ")
    print(f"{len(different)} of {len(first | second)} results differ")
    return bool(different)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
