"""The `daq` command line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.commands.arguments import Changes, Overwrite, SceneNames, load_scene
from rig.commands.command_line import create_application, run_command
from rig.core.base.console import progress, user_terminal
from rig.core.base.errors import RecordingError
from rig.core.base.output_files import allow_overwriting, prepare_outputs

if TYPE_CHECKING:
    from rig.core.scene.scene import Scene

# A dry run simulates a test completely if this needs at most this CPU time [s].
_DRY_RUN_CPU_S = 20.0
app = create_application("The instrument: record, inspect, repair and replay tests.")

# Suffixes of other formats.
OTHER_SUFFIXES = (
    ".csv", ".txt", ".npz", ".mat", ".uff", ".wav", ".tdms", ".rrd", ".yaml", ".png", ".svg", ".html",
)  # fmt: skip

# Text on the scene that scripts and clients drive.
_BENCH_SCENE = "Scene of the rig. Default: environment variable SHOTRIG_SCENE, or a rig with three dampers."

BenchScene = Annotated[str | None, f"[SCENE]: {_BENCH_SCENE}"]
Clock = Annotated[
    str | None,
    "real|fast|manual: Run in real time, as fast as possible or on request. Default: SHOTRIG_CLOCK, or real.",
]
Replace = Annotated[bool, "Replace the file if it exists."]


@app.command(example="daq record fig8-three-dampers --set test.force=2N -o sweep.mcap")
def record(
    scenes: SceneNames,
    changes: Changes = None,
    output: Annotated[
        Path | None, "FILE|DIR: Recording to write, or folder for SCENE.mcap. Default: folder recordings."
    ] = None,
    overwrite: Replace = False,
    block: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            rich_help_panel="Test",
            help="Largest number of samples per channel acquired at a time. The recording does not depend on it.",
        ),
    ] = None,
    dry_run: Annotated[bool, "Do not record. Simulate the test, and print its maxima, limits and duration."] = False,
    anyway: Annotated[bool, "Start a test even if it is expected to abort."] = False,
) -> None:
    """Run the tests of scenes and record them. Ctrl-C ends a test early (exit code 130) and keeps the recording."""
    from daq.core.measurement.estimate import check_resources, estimate
    from daq.core.measurement.run_report import is_recorded, record_and_report
    from daq.core.prediction.announcement import reject_certain_abort
    from daq.core.prediction.foresee import foresee

    if dry_run:
        for scene in scenes:
            print(f"{scene}: {foresee(load_scene(scene, changes), cpu_seconds=_DRY_RUN_CPU_S)}")
        return
    tests = [
        (scene, load_scene(scene, changes), path)
        for scene, path in zip(scenes, _recording_paths(scenes, output), strict=True)
    ]
    complete = [path for _, scene_settings, path in tests if not overwrite and is_recorded(scene_settings, path)]
    for path in complete:
        print(f"{path}: already contains the complete test of this scene. Use --overwrite to record it again.")
    tests = [test for test in tests if test[2] not in complete]
    with allow_overwriting(overwrite):
        _prepare_recordings(*(path for _, _, path in tests))
        for scene, scene_settings, path in tests:
            check_resources(estimate(scene_settings), path)
            foresight = foresee(scene_settings)
            print(f"{foresight}\n", file=sys.stderr)
            if not anyway:
                reject_certain_abort(scene, foresight)
            if code := record_and_report(scene, scene_settings, path, block):
                raise typer.Exit(code)


@app.command(
    "import",
    example="daq import bench.csv --scene mine.yaml --table channels.yaml -o bench.mcap",
    call="import_files",
    options="--from S --to S",
)
def import_recording(
    files: Annotated[
        list[Path], "FILE...: Time histories: .tdms .uff .wav .csv .txt .npz .mat .h5, or .mcap of another program."
    ],
    scene: Annotated[
        str | None,
        "SCENE: Scene that describes the test setup and its channels. Without it, FILE is only listed, not imported.",
    ] = None,
    changes: Changes = None,
    table: Annotated[
        Path | None,
        "FILE.yaml|csv: Table that assigns columns of FILE to channels. Default: columns with the names of the "
        "channels.",
    ] = None,
    *,
    from_s: float | None,
    to_s: float | None,
    output: Annotated[Path | None, "REC: Recording to write. Default: FILE.mcap."] = None,
    overwrite: Annotated[bool, "Replace the recording if it exists."] = False,
) -> None:
    """Make a recording from files of another program.

    Without --scene, the contents of the files are listed.

    The scene's test specifies the excitation. Hammer impacts and dwells of a stepped sine are detected in the samples.
    """
    from daq.commands.import_report import import_and_report, listing

    if scene is None:
        if changes or overwrite or any(option is not None for option in (table, from_s, to_s, output)):
            raise typer.BadParameter(
                "--set, --table, --from, --to, -o and --overwrite require --scene. Add --scene, or omit these options."
            )
        for line in listing(files):
            print(line)
        return
    settings = load_scene(scene, changes)
    path = output if output is not None else files[0].with_suffix(".mcap")
    _reject_other_suffix(path)
    import_and_report(files, settings, path, table, from_s, to_s, overwrite)


@app.command(
    "replay",
    example="daq replay sweep.mcap --screenshot sweep.png",
    options="--save FILE.rrd --web --screenshot FILE.png --at S --from S --to S --speed X",
)
def replay_recording(
    file: Annotated[Path, "FILE: Recording to show."], *, overwrite: Overwrite = False, **options: Any
) -> None:
    """Show a recording in the viewer, or draw a picture of it."""
    from daq.extras.viewer.show import replay

    with progress(file.stem) as report_progress:
        replay(file, overwrite=overwrite, progress=report_progress, **options)


@app.command("info", example="daq info sweep.mcap --check")
def describe_recordings(
    files: Annotated[list[Path], "FILE...: Recordings to describe."],
    check: Annotated[bool, "Read the whole file and verify every record."] = False,
) -> None:
    """Describe recordings and list the commands that can analyze them."""
    from daq.extras.viewer.description import info

    for file in files:
        print(info(file, check))


@app.command(example="daq recover damaged.mcap -o repaired.mcap")
def recover(
    file: Annotated[Path, "FILE: The incomplete or damaged recording; it is not changed."],
    output: Annotated[Path, "FIXED: Recording to write."],
    overwrite: Annotated[bool, "Replace FIXED if it exists."] = False,
) -> None:
    """Repair an incomplete or damaged recording.

    The intact part is copied to FIXED, and all lost samples are listed.
    """
    from daq.core.recording.recovery import recover as recover_recording

    _reject_other_suffix(output)
    for line in recover_recording(file, output, overwrite).report():
        print(line)


@app.command(
    "run",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    example="daq run --scene fig9 my_script.py",
)
def run_a_script(
    script: Annotated[Path, "SCRIPT.py: Python script that uses nidaqmx."],
    arguments: Annotated[
        list[str] | None,
        # Without this callback, the common callback would interpret the script's arguments as options.
        typer.Argument(metavar="[ARGS]...", help="Arguments of the script.", callback=lambda given: given),
    ] = None,
    scene: Annotated[str | None, f"SCENE: {_BENCH_SCENE}"] = None,
    changes: Changes = None,
    clock: Clock = None,
) -> None:
    """Run a nidaqmx script on the virtual rig, without changes to it."""
    from daq.extras.ni_server.script import run_script

    with user_terminal():
        code = run_script(script, arguments or [], _load_bench_scene(scene, changes), clock)
    raise typer.Exit(code)


@app.command("serve", example="daq serve fig9 --clock fast", options="--address HOST[:PORT] --port N")
def serve_a_rig(
    scene: BenchScene = None,
    changes: Changes = None,
    clock: Clock = None,
    *,
    host: str,
    port: int,
    certificate: Annotated[Path | None, "FILE.pem: The server's certificate, for TLS."] = None,
    key: Annotated[Path | None, "FILE.pem: The certificate's private key."] = None,
    client_ca: Annotated[
        Path | None,
        "FILE.pem: Certificate of an authority. Only clients with a certificate from this authority are accepted "
        "(mutual TLS).",
    ] = None,
    session_timeout: Annotated[
        float, "S: Time in seconds without connection after which the tasks of a client are closed."
    ] = 30.0,
    output: Annotated[Path | None, "FILE: Recording of all channels to write. Default: none."] = None,
    overwrite: Replace = False,
) -> None:
    """Serve the virtual instrument to clients of NI's gRPC protocol.

    Ctrl-C ends the server.
    """
    # gRPC would also print the error of a port that is in use.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from daq.extras.ni_server.serve import Certificates, serve
    from daq.extras.ni_server.served_instrument import Limits

    if (certificate is None) != (key is None) or (client_ca is not None and certificate is None):
        raise typer.BadParameter("--certificate and --key belong together, and --client-ca requires both. Give both.")
    if overwrite and output is None:
        raise typer.BadParameter("--overwrite requires -o. Add -o FILE, or omit --overwrite.")
    _check_port("--port", port)
    if session_timeout <= 0.0:
        raise typer.BadParameter(f"--session-timeout: {session_timeout:g} s is not above 0 s. Give a longer time.")
    certificates = None
    if certificate is not None and key is not None:
        certificates = Certificates(certificate, key, client_ca)
    limits = Limits(disconnect_timeout=session_timeout)
    bench = _load_bench_scene(scene, changes)
    if output is not None:
        with allow_overwriting(overwrite):
            _prepare_recordings(output)
    serve(bench, clock, host, port, certificates, limits, output, output is not None)


@app.command(
    "bench", example="daq bench fig9 --port 0", options="--address HOST[:PORT] --port N --device-port N --browser"
)
def bench_in_the_browser(
    scene: BenchScene = None,
    changes: Changes = None,
    output: Annotated[
        Path | None, "FILE: First recording; further recordings are numbered. Default: recordings/SCENE-bench.mcap."
    ] = None,
    overwrite: Replace = False,
    *,
    host: str,
    port: int,
    device_port: int,
    browser: bool,
) -> None:
    """Run a rig live in the browser.

    The page shows all channels, starts tests, assesses hammer impacts and records.
    NI clients can use the device at the same time.
    """
    # gRPC would also print the error of a port that is in use.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from daq.extras.bench_page.bench import bench

    _check_port("--port", port)
    _check_port("--device-port", device_port)
    scene_name = scene or os.environ.get("SHOTRIG_SCENE") or "default"
    path = Path("recordings") / f"{Path(scene_name).stem}-bench.mcap"
    settings = _load_bench_scene(scene, changes)
    if output is not None:
        path = output
        with allow_overwriting(overwrite):
            _prepare_recordings(path)
    bench(settings, host, port, device_port, path, output is not None, browser)


def _check_port(option: str, port: int) -> None:
    if not 0 <= port < 65536:
        raise typer.BadParameter(f"{option}: {port} is out of range. Give 0 to 65535.")


def _load_bench_scene(scene: str | None, changes: Sequence[str] | None) -> Scene | None:
    """Load the scene for a bench; return None for the default scene."""
    scene_name = scene or os.environ.get("SHOTRIG_SCENE")
    if scene_name is None and changes:
        raise typer.BadParameter("--set requires a scene. Give the name of a scene as well.")
    return None if scene_name is None else load_scene(scene_name, changes)


def _recording_paths(scenes: Sequence[str], output: Path | None) -> list[Path]:
    """Return the paths of the recordings: the given file, or files in a folder with the names of the scenes."""
    if len(scenes) == 1 and output is not None and _is_file_name(output):
        return [output]
    if output is not None and output.suffix == ".mcap":
        raise typer.BadParameter(f"-o {output}: one file cannot contain {len(scenes)} tests. Give a folder.")
    folder = output if output is not None else Path("recordings")
    paths = [folder / f"{Path(scene).stem}.mcap" for scene in scenes]
    if len(set(paths)) < len(paths):
        raise typer.BadParameter(
            f"two scenes would be recorded to the same file in {folder}. Record them one by one, with -o FILE.mcap."
        )
    return paths


def _is_file_name(path: Path) -> bool:
    """Return whether an output is a file; a new name without a suffix is a folder, as for other commands."""
    return path.suffix == ".mcap" or path.is_file() or (path.suffix != "" and not path.is_dir())


def _prepare_recordings(*paths: Path) -> None:
    """Check the paths of new recordings before the bench is switched on; the recorder checks them only afterwards.

    A missing folder is created, but not several in each other: such a path is probably mistyped.
    """
    for path in paths:
        _reject_other_suffix(path)
        folder = path.resolve().parent
        if not (folder.exists() or folder.parent.exists()):
            raise RecordingError(f"{path}: there is no folder {folder.parent}. Create it first, or correct the path.")
    prepare_outputs(*paths, error_type=RecordingError)


def _reject_other_suffix(path: Path) -> None:
    """Raise `RecordingError` for the suffix of another format, because programs would misread the recording."""
    if path.suffix.lower() in OTHER_SUFFIXES:
        raise RecordingError(
            f"{path}: a recording is an MCAP file; expected a name such as {path.with_suffix('.mcap')}. To write "
            "another format, run `analysis export` on the recording, or `analysis frf` for figures and tables."
        )


def main() -> None:
    """Run the `daq` command."""
    run_command("daq.commands.cli")
