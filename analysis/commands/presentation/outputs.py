"""Output of an `analysis` command: files, printed lines and warnings; names of the output files.

File names are derived from the names of the inputs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from analysis.core.recordings.names import sweep_name
from analysis.core.recordings.opening import require_file
from rig.core.base.output_files import name_digest, prepare_outputs

# Maximum number of characters of a channel name in a file name; file systems allow 255 bytes for the whole name.
_MAX_CHANNEL_LENGTH = 40
# Maximum number of characters of the combined names of recordings; file systems allow 255 bytes for the whole name.
_MAX_NAME_LENGTH = 60


@dataclass(frozen=True)
class CommandOutput:
    """Output of a command."""

    files: tuple[Path, ...]  # files written
    lines: tuple[str, ...]  # lines to print
    warnings: tuple[str, ...]  # warnings; each begins with the name of its recording


def with_recording_name(path: Path, warnings: Sequence[str]) -> list[str]:
    """Prefix each warning with the name of its recording."""
    return [f"{path.name}: {warning}" for warning in warnings]


def with_sweep_name(sweep: str, recording: str, warnings: Sequence[str], named: Sequence[str] = ()) -> list[str]:
    """Prefix each warning with the name of its sweep, if the recording has several sweeps.

    `sweep`, `recording`: labels; the label of a sweep is the label of the recording, followed by the name of the sweep.
    `named`: warnings about the responses, which already name the sweep where necessary.

    >>> with_sweep_name("beam, 2 N up", "beam", ["no mode"]), with_sweep_name("beam", "beam", ["no mode"])
    (['2 N up: no mode'], ['no mode'])
    """
    name = sweep_name(sweep, recording)
    return [f"{name}: {warning}" if name and warning not in named else warning for warning in warnings]


def output_stem(paths: Sequence[Path], output: Path | None, kind: str) -> Path:
    """Return the common path of the output files without file extension.

    `paths`: recordings; `output`: folder, by default the folder of the first recording; `kind`: last part of the name,
    such as "frf".
    """
    folder = output if output is not None else paths[0].parent
    return folder / f"{join_names([path.stem for path in paths])}-{kind}"


def separate_stems(paths: Sequence[Path], output: Path | None, kind: str) -> list[Path]:
    """Return the common path of the output files of each recording; equal names are distinguished by their folders."""
    stems = [output_stem([path], output, kind) for path in paths]
    return [
        stem if stems.count(stem) == 1 else stem.with_name(f"{path.resolve().parent.name}-{stem.name}")
        for path, stem in zip(paths, stems, strict=True)
    ]


def check_outputs(paths: Sequence[Path], *files: Path) -> None:
    """Check the outputs before the analysis starts; missing recordings are reported first.

    `files`: files that are always written. Raises `SceneError` if a file exists and may not be replaced.
    """
    for path in paths:
        require_file(path)
    prepare_outputs(*files)


def join_names(names: Sequence[str]) -> str:
    """Join names into one name of limited length.

    >>> join_names(["none", "three"])
    'none+three'
    >>> join_names(["a-sweep-of-a-structure-with-a-long-name", "another-one-of-the-same-kind"])
    'a-sweep-of-a-structure-with-a-long-name+1-more-0c56'
    """
    name = "+".join(names)
    if len(name) <= _MAX_NAME_LENGTH:
        return name
    # The digest distinguishes lists with the same first name and length.
    digest = name_digest(name)[:4]
    return f"{names[0]}+{len(names) - 1}-more-{digest}" if len(names) > 1 else name


def with_channel_name(stem: Path, channel: str) -> Path:
    """Append a channel name; characters that are unsafe in a file name are replaced.

    >>> with_channel_name(Path("run-frf"), "body1").name, with_channel_name(Path("run-frf"), "../../etc/passwd").name
    ('run-frf-body1', 'run-frf-.._.._etc_passwd-3754')
    """
    safe = "".join(letter if letter.isalnum() or letter in " -_.+" else "_" for letter in channel)[:_MAX_CHANNEL_LENGTH]
    return stem.with_name(f"{stem.name}-{safe}" + ("" if safe == channel else f"-{name_digest(channel)[:4]}"))


def with_ending(stem: Path, extension: str) -> Path:
    """Add a file extension to a name that may contain dots.

    >>> with_ending(Path("a0.5-report"), "html").name
    'a0.5-report.html'
    """
    return stem.with_name(f"{stem.name}.{extension}")
