"""Kinds of cases: the fault that each injects into a command, and the checks that follow."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

import daq
from daq.measurement.bench_loop import RAMP_S
from rig.ending_signals import TERMINATION_SIGNALS
from rig.errors import ShotrigError
from tests.daq.importing import files
from tests.soak import command_lines, recordings, scenes
from tests.soak.command import Ended, is_own_traceback, processes_remain, run, run_afresh

READING_COMMANDS = (
    "daq info r.mcap --check",
    "daq info r.mcap",
    "daq recover r.mcap -o f.mcap --overwrite",
    "daq replay r.mcap --save x.rrd",
    "analysis frf r.mcap",
    "analysis decay r.mcap",
    "analysis modes r.mcap",
    "analysis dampers r.mcap",
    "analysis compare r.mcap r.mcap",
    "analysis report r.mcap",
    "analysis export r.mcap -o o.csv",
    "analysis export r.mcap -o o.npz",
    "analysis export r.mcap -o o.uff",
    "analysis export r.mcap -o o.wav",
    "analysis export r.mcap -o o.csv --from {odd} --to {odd}",
    "analysis frf r.mcap --block {odd} --overlap {odd}",
    "daq replay r.mcap --save x.rrd --from {odd} --speed {odd}",
)
STUDY_COMMANDS = (
    "rig map s.yaml --rows 2 --points 3",
    "rig map s.yaml --rows 2 --points 3 --cluster local",
    "rig design s.yaml --budget 50g",
    "analysis paper",
    "analysis demo",
)
# A client script of the instrument.
CLIENT_SCRIPT = """
import nidaqmx
with nidaqmx.Task() as task:
    task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
    task.timing.cfg_samp_clk_timing(1000.0, samps_per_chan=100)
    try:
        task.read(100)
    except nidaqmx.DaqError as error:
        print("refused:", error.error_code)
"""
# Names of recordings.
RECORDING_NAMES = (
    "r.mcap",
    "r.mcap",
    os.fsdecode(b"\xff\xfe r.mcap"),
    "a\nb$c.mcap",
    scenes.MARKUP.replace("/", "") + ".mcap",
)


class Bench:
    """Undamaged recordings, and a folder to work in."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "work"
        self.scenes = {}
        self.whole = {}
        # Time that a recording takes here, s: kills happen within it.
        self.seconds: dict[int, float] = {}
        for number in (0, 1, 3):
            self.scenes[number] = folder / f"scene{number}.yaml"
            self.scenes[number].write_text(yaml.safe_dump(scenes.BASES[number]))
            self.whole[number] = folder / f"whole{number}.mcap"
            words = ["daq", "record", str(self.scenes[number]), "-o", str(self.whole[number])]
            self.seconds[number] = run(words, folder).seconds
        # Time that a command takes to start, s.
        self.start = run_afresh(["daq", "info", str(self.whole[0])], folder).seconds
        self.foreign = {}
        for name, (ending, write, _) in files.WRITERS.items():
            path = folder / f"foreign-{name.replace(' ', '-')}{ending}"
            write(path, files.histories())
            self.foreign[path.suffix, name] = path.read_bytes()

    def clear(self) -> Path:
        """Return the emptied folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        return self.folder

    def compare(self, path: Path, number: int) -> list[str]:
        """Compare a recording with the undamaged one: its samples must be equal and in their place."""
        try:
            with daq.open(path) as recording, daq.open(self.whole[number]) as expected:
                recording.check()
                # An interrupted test ends with a ramp of its drive, which the complete recording lacks.
                aborted = any(mark.kind == "abort" for mark in recording.markers)
                stop = recording.samples - (round(RAMP_S * recording.rate) if aborted else 0)
                for name in recording.channels:
                    samples = recording.read(name)[:stop]
                    valid = np.isfinite(samples)
                    if (
                        samples.size > expected.samples
                        or (samples[valid] != expected.read(name)[: samples.size][valid]).any()
                    ):
                        return ["wrong samples"]
        except ShotrigError:
            return ["not readable"]
        return []


def kill(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Kill or interrupt a recording at any moment; the file of that name, old or new, must be intact."""
    number, folder = chance.choice((0, 1, 3)), bench.clear()
    overwrite = chance.random() < 0.5
    if overwrite:
        shutil.copy(bench.whole[number], folder / "r.mcap")
    ending_signal = chance.choice((signal.SIGKILL, signal.SIGKILL, *TERMINATION_SIGNALS))
    # A new process imports first, as a user's does; forks are much quicker.
    new_process = chance.random() < 0.3
    longest = bench.seconds[number] + (bench.start if new_process else 0.0)
    send_signal = send_once(ending_signal, chance.uniform(0.0, 1.2) * longest)
    words = ["daq", "record", str(bench.scenes[number]), "-o", "r.mcap", *(["--overwrite"] if overwrite else [])]
    ended = _without_effects_of((run_afresh if new_process else run)(words, folder, end=send_signal), ending_signal)
    faults = []
    for path in sorted(folder.iterdir()):
        if path.name == "r.mcap" and (overwrite or "interrupted" in ended.output):
            faults += bench.compare(path, number)
        elif path.stat().st_size > 8:
            recovered = run(["daq", "recover", path.name, "-o", "fixed.mcap", "--overwrite"], folder)
            faults += recovered.faults
            if recovered.code == 0:
                faults += bench.compare(folder / "fixed.mcap", number)
            elif "nothing can be recovered" not in recovered.output:
                faults.append("not recovered")
    if overwrite and not (folder / "r.mcap").exists():
        faults.append("file lost")
    return ended, faults


def begin(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Interrupt any command while Python starts and imports; existing files must not change."""
    folder = bench.clear()
    shutil.copy(bench.whole[0], folder / "r.mcap")
    (folder / "s.yaml").write_text(scenes.sound(chance))
    ending_signal = chance.choice((signal.SIGTERM, signal.SIGINT, signal.SIGINT))
    send_signal = send_once(ending_signal, chance.uniform(0.0, 2.0) * bench.start)
    words = scenes.command("s.yaml", chance) if chance.random() < 0.3 else _reading(chance)
    ended = _without_effects_of(run_afresh(words, folder, send_signal, module=chance.random() < 0.5), ending_signal)
    return ended, bench.compare(folder / "r.mcap", 0) if words[1] != "record" else []


def end_study(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Interrupt a study with all its workers, as a terminal does; no process may complain or remain."""
    folder = bench.clear()
    (folder / "s.yaml").write_text(yaml.safe_dump(scenes.BASES[0]))
    ending_signal, groups = chance.choice((signal.SIGINT, signal.SIGINT, signal.SIGTERM)), []
    strike_time = chance.uniform(0.5, 8.0) * bench.start

    def send_signal(process: int, seconds: float) -> None:
        if seconds > strike_time and not groups:
            groups.append(process)
            os.killpg(process, ending_signal)

    ended = _without_effects_of(run_afresh(chance.choice(STUDY_COMMANDS).split(), folder, send_signal), ending_signal)
    return ended, ["process left"] if any(processes_remain(group) for group in groups) else []


def send_once(ending_signal: signal.Signals, strike_time: float) -> Callable[[int, float], None]:
    """Return a function that sends a signal once, after a time in s."""
    sent = []

    def send_signal(process: int, seconds: float) -> None:
        if seconds > strike_time and not sent:
            sent.append(os.kill(process, ending_signal))

    return send_signal


def _without_effects_of(ended: Ended, ending_signal: signal.Signals) -> Ended:
    """Remove the effects that a signal may have on any process, and on Python before our code runs."""
    output = ended.output
    if (
        ending_signal == signal.SIGINT
        and "Traceback" in output
        and not is_own_traceback(output)
        and "interrupted" not in output
    ):
        output = ""
    # Before the command line handles signals, they end it as any process; an interrupt in code that a library is
    # compiling ends Python in the same way.
    return replace(ended, code=0 if ended.code in (-ending_signal, -signal.SIGINT) else ended.code, output=output)


def damage(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Damage a recording and recover it over another; no wrong sample may result, and the other file must survive."""
    number, folder = chance.choice((0, 1, 3)), bench.clear()
    (folder / "r.mcap").write_bytes(recordings.damage(bench.whole[number].read_bytes(), chance))
    shutil.copy(bench.whole[number], folder / "f.mcap")
    words = _reading(
        chance,
        (READING_COMMANDS[0], READING_COMMANDS[2], READING_COMMANDS[2], READING_COMMANDS[2], *READING_COMMANDS[1:]),
    )
    ended = run(words, folder)
    faults = bench.compare(folder / "f.mcap", number) if (folder / "f.mcap").exists() else ["file lost"]
    if words[1] == "info" and "--check" in words and ended.code == 0:
        faults += bench.compare(folder / "r.mcap", number)
    return ended, faults


def fill_disk(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Limit the size of files; existing files stay intact, and no partial file may appear under the final name."""
    number, folder = chance.choice((0, 1, 3)), bench.clear()
    shutil.copy(bench.whole[number], folder / "r.mcap")
    max_bytes = int(10 ** chance.uniform(1, 6))
    record = ["daq", "record", str(bench.scenes[number]), "-o", "r.mcap", "--overwrite"]
    words = record if chance.random() < 0.1 else _reading(chance, READING_COMMANDS[2:])

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    ended = run(words, folder, prepare=limit)
    faults = bench.compare(folder / "r.mcap", number) if (folder / "r.mcap").exists() else ["file lost"]
    return ended, faults


def odd_scene(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Run a command with an invalid scene and invalid options."""
    folder = bench.clear()
    (folder / "s.yaml").write_text(scenes.scene(chance))
    return run(scenes.command("s.yaml", chance), folder), []


def rarer_command(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Run a rarely used command with invalid options, and in half of the cases an invalid scene."""
    folder = bench.clear()
    (folder / "s.yaml").write_text((scenes.scene if chance.random() < 0.5 else scenes.sound)(chance))
    shutil.copy(bench.whole[0], folder / "r.mcap")
    (folder / "x.csv").write_bytes(next(data for (end, _), data in bench.foreign.items() if end == ".csv"))
    (folder / "c.py").write_text(CLIENT_SCRIPT)
    words = scenes.rarer_command("s.yaml", chance)
    # Servers and viewers run until a signal. Send one only: a second one ends them while they close their files.
    runs_forever = words[1] in ("serve", "scope")
    return run(words, folder, end=send_once(signal.SIGTERM, 15.0) if runs_forever else None), []


def odd_recording(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Run a command on a recording with invalid contents but correct checksums."""
    folder = bench.clear()
    name = chance.choice(RECORDING_NAMES)
    recordings.hostile(bench.whole[chance.choice((0, 1, 3))], folder / name, chance)
    return run([name if word == "r.mcap" else word for word in _reading(chance)], folder), []


def odd_words(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Run any command with any options and invalid values; files, folders and devices must not change."""
    folder = bench.clear()
    shutil.copy(bench.whole[0], folder / "r.mcap")
    (folder / "s.yaml").write_text(scenes.sound(chance))
    (folder / "x.csv").write_bytes(next(data for (end, _), data in bench.foreign.items() if end == ".csv"))
    (folder / "c.py").write_text(CLIENT_SCRIPT)
    command_lines.create_odd_files(folder)
    before = command_lines.contents(folder)
    words = command_lines.draw(chance)
    # End commands that run on, and earlier those that wait silently for their user, as they should.
    latest_end = 15.0 if words[1] in ("serve", "scope", "replay") else 25.0
    ended = run(words, folder, end=send_once(signal.SIGTERM, chance.uniform(5.0, latest_end)))
    return _without_effects_of(ended, signal.SIGTERM), command_lines.lost(before, command_lines.contents(folder), words)


def _reading(chance: random.Random, commands: Sequence[str] = READING_COMMANDS) -> list[str]:
    """Choose a command on a recording, with invalid numbers for its numeric options."""
    odd_numbers = [chance.choice(scenes.ODD_NUMBERS) for _ in range(2)]
    return [word.format(odd=odd_numbers.pop()) if "{" in word else word for word in chance.choice(commands).split()]


def odd_import(bench: Bench, chance: random.Random) -> tuple[Ended, list[str]]:
    """Import a damaged file of another program; an existing recording must survive."""
    folder = bench.clear()
    (ending, _), content = chance.choice(list(bench.foreign.items()))
    (folder / f"x{ending}").write_bytes(recordings.damage(content, chance))
    (folder / "s.yaml").write_text(files.bench().to_yaml())
    shutil.copy(bench.whole[0], folder / "r.mcap")
    words = ["daq", "import", f"x{ending}", *chance.choice(((), ("--scene", "s.yaml", "-o", "r.mcap", "--overwrite")))]
    ended = run(words, folder)
    if ended.code and bench.compare(folder / "r.mcap", 0):
        return ended, ["file lost"]
    return ended, []


KINDS: dict[str, Callable[[Bench, random.Random], tuple[Ended, list[str]]]] = {
    "kills": kill,
    "starts": begin,
    "studies": end_study,
    "damage": damage,
    "disks": fill_disk,
    "scenes": odd_scene,
    "commands": rarer_command,
    "words": odd_words,
    "recordings": odd_recording,
    "imports": odd_import,
}
