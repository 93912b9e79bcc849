"""The signals of a file of another program, listed by the reader that its suffix selects."""

from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path

from daq.extras.importing.signal import Signal
from rig.core.base.errors import RecordingError

# Suffix: module of this package, and its function; imported when needed, because their packages are optional.
_TEXT = ("text_table", "text_signals")
_ARRAYS = ("arrays", "array_signals")
_SOUND = ("sound", "sound_signals")
_UNIVERSAL = ("uff", "uff_signals")
READERS = {
    ".tdms": ("tdms", "tdms_signals"),
    ".uff": _UNIVERSAL,
    ".unv": _UNIVERSAL,
    ".wav": _SOUND,
    ".w64": _SOUND,
    ".flac": _SOUND,
    ".aiff": _SOUND,
    ".aif": _SOUND,
    ".csv": _TEXT,
    ".txt": _TEXT,
    ".tsv": _TEXT,
    ".lvm": _TEXT,
    ".asc": _TEXT,
    ".dat": _TEXT,
    ".npz": _ARRAYS,
    ".npy": _ARRAYS,
    ".mat": _ARRAYS,
    ".h5": _ARRAYS,
    ".hdf5": _ARRAYS,
    ".mcap": ("float_topics", "mcap_signals"),
}


def signals_of(path: Path, stack: ExitStack) -> list[Signal]:
    """List the signals of a file, which stays open until `stack` is closed.

    Raises `RecordingError` for a file without readable signals, `RunError` for a missing package.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file. Check the path.")
    if not path.is_file():
        raise RecordingError(f"{path} is not a file. Give the path of each file to import.")
    # Programs give text tables many suffixes.
    module, function = READERS.get(path.suffix.lower(), _TEXT)
    read: Callable[[Path, ExitStack], list[Signal]] = getattr(import_module(f"daq.extras.importing.{module}"), function)
    try:
        signals = [signal for signal in read(path, stack) if signal.samples > 1]
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror or error}. Check the file and its disk.") from error
    except MemoryError:
        raise RecordingError(
            f"{path} does not fit into memory. Export it as TDMS, WAV or CSV, which are read in pieces."
        ) from None
    if not signals:
        raise RecordingError(f"{path} contains no samples. Export time histories of at least two samples.")
    return signals
