"""Random command lines: any command with any of its options, valid and invalid."""

import hashlib
import os
import random
import stat
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from tests.soak.command import PACKAGES
from tests.soak.scenes import UNUSUAL_TEXTS

# Valid values of each option or argument, by its name; options that are not listed take a number.
VALID_VALUES: dict[str, tuple[str, ...]] = {
    "scene": ("s.yaml", "fig9", "bare-structure"),
    "scenes": ("s.yaml", "fig9"),
    "file": ("r.mcap",),
    "files": ("r.mcap", "x.csv"),
    "script": ("c.py",),
    "changes": ("seed=2", "test.force=3N", "structure.masses[1]=0.7kg"),
    "output": ("new", "new.mcap", "new.csv", "new.npz", "new.uff", "folder"),
    "save": ("new.rrd",),
    "screenshot": ("new.png",),
    "table": ("table.yaml",),
    "duration": ("0.05 s",),
    "rate": ("5120 Hz",),
    "frequency": ("20", "20 Hz"),
    "first": ("20 Hz",),
    "last": ("21 Hz",),
    "lowest": ("1 N",),
    "highest": ("2 N",),
    "over": ("force", "clearance"),
    "direction": ("up", "both"),
    "channel": ("body1",),
    "response": ("body1",),
    "reference": ("force", "table"),
    "motion": ("velocity", "displacement"),
    "estimator": ("H1", "Hv"),
    "window": ("hann", "none"),
    "unit": ("g/N", "m/N"),
    "what": ("samples", "frfs", "modes"),
    "budget": ("50 g", "5 %"),
    "clearance": ("0.2 mm,3 mm",),
    "levels": ("1 N,2 N",),
    "band": ("20 Hz,25 Hz",),
    "bodies": ("1", "1,2"),
    "response_bodies": ("1",),
    "damping_uncertainty": ("10 %",),
    "stiffness_uncertainty": ("5 %",),
    "free": ("structure.masses",),
    "clock": ("fast", "real"),
    "address": ("127.0.0.1",),
    "port": ("0",),
    "key": ("c.py",),
    "copy": ("fig9", "new.yaml"),
    "show": ("fig9",),
    "cluster": ("tcp://127.0.0.1:9",),
}
# Unusual paths, including those of `create_unusual_files`.
PATHS = (
    "folder",
    "folder/",
    "fifo",
    "null",
    "full",
    "zero",
    "loop",
    "dangling",
    "missing.mcap",
    "missing/deep/x.csv",
    "empty.mcap",
    "empty.yaml",
    "binary.yaml",
    "r.mcap",
    "s.yaml",
    "x.csv",
    "c.py",
    "c.py/x.mcap",
    ".",
    "..",
    "",
    "new.exe",
    "x" * 300 + ".mcap",
    "new\n\x1b[31m.mcap",
    os.fsdecode(b"\xff\xfe.mcap"),
)
# Unusual numbers.
NUMBERS = (
    "nan",
    "-inf",
    "1e309",
    "-1",
    "0",
    "-0.0",
    "1e300",
    "1e-320",
    "1" * 400,
    "0x10",
    "1_000",
    "1,5",
    "\u0663",
    "1e12",
    "99999999999999999999",
    "2.5",
    "1 2",
    "",
)
# Valid and unusual units.
UNITS = ("", "", " Hz", "Hz", " s", " N", " kg", " mm", " %", " parsec", " Hz Hz", ",", ",1", "\u00b5s", "\x1b[1m")
# Unusual texts.
TEXTS = (
    *(text.replace("\0", "") for text in UNUSUAL_TEXTS),
    os.fsdecode(b"\xff"),
    "-",
    "--",
    "@x",
    "*",
    "%s%n",
    "a=b=c",
    "seed=",
    "=1",
    "seed=nan",
    "test.force=1e309 N",
    "test={kind: x}",
    "dampers[0].mass=1kg",
    "dampers[999999999]=1",
    "structure.masses=[1e308 kg]",
    "x: [",
    "structure",
    "..",
)


def create_unusual_files(folder: Path) -> None:
    """Create special, empty and invalid files in a folder."""
    (folder / "folder").mkdir()
    (folder / "folder" / "kept.txt").write_text("kept")
    for name in ("empty.mcap", "empty.yaml"):
        (folder / name).touch()
    (folder / "binary.yaml").write_bytes(bytes(range(256)))
    (folder / "table.yaml").write_text("body1: {column: ai0, unit: g}\n")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("nowhere")
    os.mkfifo(folder / "fifo")
    for name, minor in (("null", 3), ("zero", 5), ("full", 7)):
        try:
            os.mknod(folder / name, stat.S_IFCHR | 0o666, os.makedev(1, minor))
        except PermissionError:
            # Without root privileges: link to the system's device.
            (folder / name).symlink_to(f"/dev/{name}")


def folder_contents(folder: Path) -> dict[str, str]:
    """Return the digest of each regular file in a folder, and the type of other files, by path."""
    return {str(path.relative_to(folder)): _content(path) for path in sorted(folder.rglob("*"))}


def _content(path: Path) -> str:
    mode = path.lstat().st_mode
    if stat.S_ISREG(mode):
        return hashlib.blake2b(path.read_bytes()).hexdigest()
    return f"{stat.S_IFMT(mode):o}"


def lost_files(before: dict[str, str], after: dict[str, str], words: list[str]) -> list[str]:
    """Return messages about files that a command lost or changed; only --overwrite may replace a regular file."""
    messages = [f"file lost: {name}" for name in before if name not in after]
    for name in before.keys() & after.keys():
        # A digest is longer than the code of a type.
        is_regular = len(before[name]) > 6 and len(after[name]) > 6
        if before[name] != after[name] and not (is_regular and "--overwrite" in words):
            messages.append(f"file changed: {name}")
    return sorted(messages)


def draw_command_line(rng: random.Random) -> list[str]:
    """Draw a command of any package, with some of its options and arguments; some values are unusual."""
    program = rng.choice(PACKAGES)
    commands: Any = typer.main.get_command(import_module(f"{program}.commands.cli").app)
    name = rng.choice(list(commands.commands))
    unusual_ratio = rng.choice((0.2, 0.5, 0.9))
    options, arguments = [], []
    for parameter in commands.commands[name].params:
        if rng.random() > (0.95 if parameter.required else 0.25):
            continue
        if parameter.param_type_name == "argument":
            arguments += [
                _value(parameter, unusual_ratio, rng)
                for _ in range(rng.choice((1, 1, 2)) if parameter.nargs < 0 else 1)
            ]
        elif parameter.is_flag:
            options.append([parameter.opts[0]])
        else:
            options.append(
                [rng.choice(parameter.opts), *(_value(parameter, unusual_ratio, rng) for _ in range(parameter.nargs))]
            )
    if rng.random() < 0.05:
        options.append([rng.choice(("--nonsense", "-x", "--help", "-o", "--", "--set"))])
    if rng.random() < 0.1:
        rng.shuffle(arguments)
    rng.shuffle(options)
    option_words = [word for option in options for word in option]
    # `daq run` passes all arguments after the name of the script to it: options come first.
    return [program, name, *((*option_words, *arguments) if name == "run" else (*arguments, *option_words))]


def _value(option: Any, unusual_ratio: float, rng: random.Random) -> str:
    """Draw a value of an option or an argument: unusual with a probability of `unusual_ratio`."""
    if rng.random() > unusual_ratio:
        return rng.choice(VALID_VALUES.get(option.name, ("1", "2", "0.5")))
    kind = rng.random()
    if kind < 0.4:
        return rng.choice(NUMBERS) + rng.choice(UNITS)
    return rng.choice(PATHS if kind < 0.75 else TEXTS)
