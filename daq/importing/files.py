"""The reader of a file, chosen by the ending of its name."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from daq.importing.signal import Signal
from rig.errors import RecordingError

ENDINGS = (
    ".tdms",
    ".uff",
    ".unv",
    ".wav",
    ".csv",
    ".txt",
    ".tsv",
    ".lvm",
    ".dat",
    ".npz",
    ".npy",
    ".mat",
    ".mcap",
)


def signals_of(path: Path, stack: ExitStack) -> list[Signal]:
    """List the signals of a file, which stays open until the stack is left.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no signal.
    RunError
        If the package for its format is not installed.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    if not path.is_file():
        raise RecordingError(f"{path} is no file")
    try:
        found = _read(path, stack)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror or error}") from error
    except MemoryError:
        raise RecordingError(
            f"{path} does not fit into memory; export it as TDMS, WAV or CSV, which are read in pieces"
        ) from None
    found = [signal for signal in found if signal.samples > 1]
    if not found:
        raise RecordingError(f"{path} holds no samples")
    return found


def _read(path: Path, stack: ExitStack) -> list[Signal]:
    ending = path.suffix.lower()
    if ending == ".tdms":
        from daq.importing.tdms import tdms_signals

        return tdms_signals(path, stack)
    if ending in (".uff", ".unv"):
        from daq.importing.uff import uff_signals

        return uff_signals(path)
    if ending == ".wav":
        from daq.importing.wav import wav_signals

        return wav_signals(path)
    if ending in (".npz", ".npy"):
        from daq.importing.arrays import numpy_signals

        return numpy_signals(path)
    if ending == ".mat":
        from daq.importing.arrays import matlab_signals

        return matlab_signals(path)
    if ending == ".mcap":
        from daq.importing.float_topics import mcap_signals

        return mcap_signals(path)
    if ending in ENDINGS:
        from daq.importing.text_table import text_signals

        return text_signals(path, stack)
    raise RecordingError(f"{path}: expected a file whose name ends in one of {', '.join(ENDINGS)}")
