"""Kinds of cases: functions that inject a random fault into a command and check its files afterwards.

Each function returns the result of the command and the faults of the files. It draws all random choices from ``rng``.
"""

import math
import os
import random
import resource
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml

import daq
from daq.core.measurement.bench_loop import RAMP_S
from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import ShotrigError
from tests.daq.importing import files
from tests.soak import attacks, command_lines, recordings, scenes, servers
from tests.soak.command import CommandResult, is_own_traceback, processes_remain, run, run_new_process

# Commands that read a recording r.mcap; {unusual}: an invalid number.
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
    "analysis srs r.mcap",
    "analysis profile r.mcap",
    "analysis backbone r.mcap",
    "analysis continuation r.mcap",
    "analysis surface r.mcap",
    "analysis report r.mcap",
    "analysis export r.mcap -o o.csv",
    "analysis export r.mcap -o o.npz",
    "analysis export r.mcap -o o.uff",
    "analysis export r.mcap -o o.wav",
    "analysis export r.mcap -o o.csv --from {unusual} --to {unusual}",
    "analysis frf r.mcap --block {unusual} --overlap {unusual}",
    "daq replay r.mcap --save x.rrd --from {unusual} --speed {unusual}",
)
# Commands that compute many motions in several processes.
STUDY_COMMANDS = (
    "rig map s.yaml --rows 2 --points 3",
    "rig design s.yaml --budget 50g",
    "analysis paper",
    "analysis demo",
)
# Commands that write files from a recording r.mcap or a table x.csv, and the files.
WRITING_COMMANDS = {
    "daq recover r.mcap -o out.mcap": "out.mcap",
    "daq import x.csv --scene s.yaml -o out.mcap": "out.mcap",
    "analysis export r.mcap -o out.csv": "out.csv",
    "analysis export r.mcap -o out.npz": "out.npz",
    "analysis export r.mcap -o out.uff": "out.uff",
    "analysis report r.mcap -o out.html": "out.html",
    "analysis dampers r.mcap": "r-dampers.csv",
    "analysis srs r.mcap": "r-srs.svg",
    "rig simulate damper.yaml --duration 0.5s -o out.npz": "out.npz",
    "rig response damper.yaml --from 49Hz --to 50Hz --points 2 -o out.csv": "out.csv",
}
# The same for commands that compute for several seconds, and continue the work of an interrupted run.
WRITING_STUDIES = {
    "rig map damper.yaml --rows 2 --points 2 --from 49Hz --to 50Hz": "map-damper.csv",
    "rig design damper.yaml --budget 50g --bodies 1 --levels 1N --clearance 1mm,1.1mm": "design-damper.csv",
}
# Share of the cases of interrupted writing that interrupt a study.
_STUDY_SHARE = 0.05
# Number of the scene with a damper that these commands use.
_DAMPER_SCENE = 10
# A client script for `daq run`.
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
# Valid and unusual names of recordings.
RECORDING_NAMES = (
    "r.mcap",
    "r.mcap",
    os.fsdecode(b"\xff\xfe r.mcap"),
    "a\nb$c.mcap",
    scenes.MARKUP.replace("/", "") + ".mcap",
)


class Workspace:
    """Undamaged scenes, recordings and files of other programs, and a folder in which commands run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "work"
        # Scene file, undamaged recording, and duration of the recording command, by index in `scenes.VALID_SCENES`.
        self.scenes: dict[int, Path] = {}
        self.recordings: dict[int, Path] = {}
        self.recording_seconds: dict[int, float] = {}
        for number in scenes.RECORDED_SCENES:
            self.scenes[number] = folder / f"scene{number}.yaml"
            self.scenes[number].write_text(yaml.safe_dump(scenes.VALID_SCENES[number]))
        # Duration of a complete writing command [s], size of its file and names of all files, by command.
        self.completed: dict[str, tuple[float, int, set[str]]] = {}

    def undamaged(self, number: int) -> Path:
        """Return the recording of a scene; it is made at the first call."""
        if number not in self.recordings:
            path = self.scenes[number].with_name(f"undamaged{number}.mcap")
            words = ["daq", "record", str(self.scenes[number]), "-o", str(path)]
            self.recording_seconds[number] = run(words, path.parent, time_limit=math.inf).seconds
            self.recordings[number] = path
        return self.recordings[number]

    @cached_property
    def startup_seconds(self) -> float:
        """Time from the start of a short command in a new process to its end, s."""
        return run_new_process(["daq", "info", str(self.undamaged(0))], self.folder.parent).seconds

    @cached_property
    def foreign_files(self) -> dict[tuple[str, str], bytes]:
        """Contents of files of other programs, by suffix and name of the writer."""
        contents = {}
        for name, (ending, write, _) in files.WRITERS.items():
            path = self.folder.with_name(f"foreign-{name.replace(' ', '-')}{ending}")
            write(path, files.random_samples())
            contents[path.suffix, name] = path.read_bytes()
        return contents

    def clear(self) -> Path:
        """Return the emptied folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        return self.folder

    def recording_faults(self, path: Path, number: int) -> list[str]:
        """Return the faults of a recording: samples that differ from the undamaged recording of a scene."""
        try:
            with daq.open(path) as recording, daq.open(self.undamaged(number)) as expected:
                recording.check()
                # Ignore the ramp of the drive to zero at the end of an interrupted test.
                aborted = any(marker.kind == "abort" for marker in recording.markers)
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


def interrupt_recording(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Kill or interrupt `daq record` at a random time; the old or the new file must be intact."""
    number, folder = rng.choice(scenes.RECORDED_SCENES), workspace.clear()
    undamaged = workspace.undamaged(number)
    overwrite = rng.random() < 0.5
    if overwrite:
        shutil.copy(undamaged, folder / "r.mcap")
    signal_number = rng.choice((signal.SIGKILL, signal.SIGKILL, *TERMINATION_SIGNALS))
    # A new process first imports the packages, as for a user; a fork is much faster.
    new_process = rng.random() < 0.3
    duration = workspace.recording_seconds[number] + (workspace.startup_seconds if new_process else 0.0)
    send_signal = signal_sender(signal_number, rng.uniform(0.0, 1.2) * duration)
    words = ["daq", "record", str(workspace.scenes[number]), "-o", "r.mcap", *(["--overwrite"] if overwrite else [])]
    result = _without_signal_effects(
        (run_new_process if new_process else run)(words, folder, on_poll=send_signal), signal_number
    )
    faults = []
    for path in sorted(folder.iterdir()):
        if path.name == "r.mcap" and (overwrite or "interrupted" in result.output):
            faults += workspace.recording_faults(path, number)
        elif path.stat().st_size > 8:
            recovered = run(["daq", "recover", path.name, "-o", "fixed.mcap", "--overwrite"], folder)
            faults += recovered.faults
            if recovered.code == 0:
                faults += workspace.recording_faults(folder / "fixed.mcap", number)
            elif "nothing can be recovered" not in recovered.output:
                faults.append("not recovered")
    if overwrite and not (folder / "r.mcap").exists():
        faults.append("file lost")
    return result, faults


def interrupt_writing(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Kill or interrupt a command while it replaces a file: the old or the new file must be complete."""
    commands = WRITING_STUDIES if rng.random() < _STUDY_SHARE else WRITING_COMMANDS
    command, folder = rng.choice(list(commands)), workspace.clear()
    output = folder / commands[command]
    shutil.copy(workspace.undamaged(0), folder / "r.mcap")
    shutil.copy(workspace.scenes[_DAMPER_SCENE], folder / "damper.yaml")
    (folder / "s.yaml").write_text(files.make_scene().to_yaml())
    (folder / "x.csv").write_bytes(workspace.foreign_files[".csv", "csv"])
    output.write_bytes(old := b"old")
    words = [*command.split(), "--overwrite"]
    if command not in workspace.completed:
        completed = run(words, folder)
        if completed.code:
            return completed, ["not written"]
        names = {path.name for path in folder.iterdir()}
        workspace.completed[command] = completed.seconds, output.stat().st_size, names
        output.write_bytes(old)
    seconds, size, before = workspace.completed[command]
    signal_number = rng.choice((signal.SIGKILL, signal.SIGKILL, *TERMINATION_SIGNALS))
    result = run(words, folder, on_poll=signal_sender(signal_number, rng.uniform(0.0, 1.1) * seconds))
    faults = workspace.recording_faults(folder / "r.mcap", 0)
    if output.read_bytes() != old and not (0.99 * size <= output.stat().st_size <= 1.01 * size):
        faults.append("incomplete file")
    # The next run removes what a kill has left behind.
    again = run(words, folder)
    faults += again.faults + (["not written again"] if again.code else [])
    faults += [f"left behind: {path.suffix}" for path in folder.iterdir() if path.name not in before]
    return _without_signal_effects(result, signal_number), faults


def interrupt_startup(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Interrupt a command while Python starts and imports; existing files must not change."""
    folder = workspace.clear()
    shutil.copy(workspace.undamaged(0), folder / "r.mcap")
    (folder / "s.yaml").write_text(scenes.valid_scene(rng))
    signal_number = rng.choice((signal.SIGTERM, signal.SIGINT, signal.SIGINT))
    send_signal = signal_sender(signal_number, rng.uniform(0.0, 2.0) * workspace.startup_seconds)
    words = scenes.scene_command("s.yaml", rng) if rng.random() < 0.3 else _reading_command(rng)
    result = _without_signal_effects(
        run_new_process(words, folder, send_signal, module=rng.random() < 0.5), signal_number
    )
    return result, workspace.recording_faults(folder / "r.mcap", 0) if words[1] != "record" else []


def interrupt_study(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Interrupt a study with all its workers, as a terminal does; no process may print a traceback or remain."""
    folder = workspace.clear()
    (folder / "s.yaml").write_text(yaml.safe_dump(scenes.VALID_SCENES[0]))
    signal_number, groups = rng.choice((signal.SIGINT, signal.SIGINT, signal.SIGTERM)), []
    signal_time = rng.uniform(0.5, 8.0) * workspace.startup_seconds

    def send_signal(process: int, seconds: float) -> None:
        if seconds > signal_time and not groups:
            groups.append(process)
            os.killpg(process, signal_number)

    result = _without_signal_effects(
        run_new_process(rng.choice(STUDY_COMMANDS).split(), folder, send_signal), signal_number
    )
    return result, ["process remains"] if any(processes_remain(group) for group in groups) else []


def signal_sender(signal_number: signal.Signals, signal_time: float) -> Callable[[int, float], None]:
    """Return a function for ``on_poll`` of `run` that sends a signal once, after a time [s]."""
    sent = []

    def send_signal(process: int, seconds: float) -> None:
        if seconds > signal_time and not sent:
            sent.append(os.kill(process, signal_number))

    return send_signal


def _without_signal_effects(result: CommandResult, signal_number: signal.Signals) -> CommandResult:
    """Remove from a result the allowed effects of a signal on a process and on the start of Python."""
    output = result.output
    if (
        signal_number == signal.SIGINT
        and "Traceback" in output
        and not is_own_traceback(output)
        and "interrupted" not in output
    ):
        output = ""
    # A signal may end a process before the command line handles signals, and while a library compiles code.
    return replace(result, code=0 if result.code in (-signal_number, -signal.SIGINT) else result.code, output=output)


def damage_recording(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Read a damaged recording, mostly to recover it over another file; no sample may be wrong, no file lost."""
    number, folder = rng.choice(scenes.RECORDED_SCENES), workspace.clear()
    (folder / "r.mcap").write_bytes(recordings.damage(workspace.undamaged(number).read_bytes(), rng))
    shutil.copy(workspace.undamaged(number), folder / "f.mcap")
    words = _reading_command(
        rng, (READING_COMMANDS[0], READING_COMMANDS[2], READING_COMMANDS[2], READING_COMMANDS[2], *READING_COMMANDS[1:])
    )
    result = run(words, folder)
    faults = workspace.recording_faults(folder / "f.mcap", number) if (folder / "f.mcap").exists() else ["file lost"]
    if words[1] == "info" and "--check" in words and result.code == 0:
        faults += workspace.recording_faults(folder / "r.mcap", number)
    return result, faults


def fill_disk(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Limit the size of files, as a full disk does; the existing recording must stay intact."""
    number, folder = rng.choice(scenes.RECORDED_SCENES), workspace.clear()
    shutil.copy(workspace.undamaged(number), folder / "r.mcap")
    max_bytes = int(10 ** rng.uniform(1, 6))
    record = ["daq", "record", str(workspace.scenes[number]), "-o", "r.mcap", "--overwrite"]
    words = record if rng.random() < 0.1 else _reading_command(rng, READING_COMMANDS[2:])

    def limit() -> None:
        # Python does not notice that it writes only a part of a compiled module.
        sys.dont_write_bytecode = True
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    result = run(words, folder, prepare=limit)
    faults = workspace.recording_faults(folder / "r.mcap", number) if (folder / "r.mcap").exists() else ["file lost"]
    return result, faults


def use_invalid_scene(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Run a command with an invalid scene and invalid options."""
    folder = workspace.clear()
    (folder / "s.yaml").write_text(scenes.invalid_scene(rng))
    return run(scenes.scene_command("s.yaml", rng), folder), []


def use_rare_command(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Run a rarely used command with invalid options, in half of the cases on an invalid scene."""
    folder = workspace.clear()
    (folder / "s.yaml").write_text((scenes.invalid_scene if rng.random() < 0.5 else scenes.valid_scene)(rng))
    shutil.copy(workspace.undamaged(0), folder / "r.mcap")
    (folder / "x.csv").write_bytes(next(data for (end, _), data in workspace.foreign_files.items() if end == ".csv"))
    (folder / "c.py").write_text(CLIENT_SCRIPT)
    words = scenes.rare_command("s.yaml", rng)
    # Servers and viewers run until a signal. A second signal would end them while they close their files.
    runs_forever = words[1] == "serve"
    return run(words, folder, on_poll=signal_sender(signal.SIGTERM, 15.0) if runs_forever else None), []


def use_invalid_recording(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Run a command on a recording with invalid contents but correct checksums."""
    folder = workspace.clear()
    name = rng.choice(RECORDING_NAMES)
    recordings.write_invalid_recording(workspace.undamaged(rng.choice(scenes.RECORDED_SCENES)), folder / name, rng)
    return run([name if word == "r.mcap" else word for word in _reading_command(rng)], folder), []


def use_random_command_line(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Run a random command line; files, folders and devices must not change."""
    folder = workspace.clear()
    shutil.copy(workspace.undamaged(0), folder / "r.mcap")
    (folder / "s.yaml").write_text(scenes.valid_scene(rng))
    (folder / "x.csv").write_bytes(next(data for (end, _), data in workspace.foreign_files.items() if end == ".csv"))
    (folder / "c.py").write_text(CLIENT_SCRIPT)
    command_lines.create_unusual_files(folder)
    before = command_lines.folder_contents(folder)
    words = command_lines.draw_command_line(rng)
    # End commands that do not end by themselves; end those that wait silently for their user earlier.
    latest_end = 15.0 if words[1] in ("serve", "replay") else 25.0
    result = run(words, folder, on_poll=signal_sender(signal.SIGTERM, rng.uniform(5.0, latest_end)))
    return _without_signal_effects(result, signal.SIGTERM), command_lines.lost_files(
        before, command_lines.folder_contents(folder), words
    )


def _reading_command(rng: random.Random, commands: Sequence[str] = READING_COMMANDS) -> list[str]:
    """Draw a command that reads a recording, with invalid numbers for its numeric options."""
    numbers = [rng.choice(scenes.UNUSUAL_NUMBERS) for _ in range(2)]
    return [word.format(unusual=numbers.pop()) if "{" in word else word for word in rng.choice(commands).split()]


def import_damaged_file(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Import a damaged file of another program; an existing recording must survive."""
    folder = workspace.clear()
    (ending, _), content = rng.choice(list(workspace.foreign_files.items()))
    (folder / f"x{ending}").write_bytes(recordings.damage(content, rng))
    (folder / "s.yaml").write_text(files.make_scene().to_yaml())
    shutil.copy(workspace.undamaged(0), folder / "r.mcap")
    words = ["daq", "import", f"x{ending}", *rng.choice(((), ("--scene", "s.yaml", "-o", "r.mcap", "--overwrite")))]
    result = run(words, folder)
    if result.code and workspace.recording_faults(folder / "r.mcap", 0):
        return result, ["file lost"]
    return result, []


def interrupt_server(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Kill or interrupt a bench or a server while it records."""
    return servers.interrupt_server(workspace.clear(), rng)


def attack_bench(workspace: Workspace, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Attack the page or the server of a bench."""
    return attacks.attack(workspace.scenes[0], workspace.clear(), rng)


KINDS: dict[str, Callable[[Workspace, random.Random], tuple[CommandResult, list[str]]]] = {
    "kills": interrupt_recording,
    "writing": interrupt_writing,
    "starts": interrupt_startup,
    "studies": interrupt_study,
    "damage": damage_recording,
    "disks": fill_disk,
    "scenes": use_invalid_scene,
    "commands": use_rare_command,
    "words": use_random_command_line,
    "recordings": use_invalid_recording,
    "imports": import_damaged_file,
    "servers": interrupt_server,
    "attacks": attack_bench,
}
