"""The signals of a file of another program, listed by the reader that its suffix selects."""

import errno
from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from tempfile import gettempdir

from daq.extras.importing.signal import Signal
from rig.core.base.errors import RecordingError

# Module of this package and its function: suffixes of its files. Modules are imported when needed, because the packages
# that they use are optional.
_READERS = {
    ("tdms", "tdms_signals"): (".tdms",),
    ("uff", "uff_signals"): (".uff", ".unv"),
    ("sound", "sound_signals"): (".wav", ".w64", ".flac", ".aiff", ".aif"),
    ("arrays", "array_signals"): (".npz", ".npy", ".mat", ".h5", ".hdf5"),
    ("float_topics", "mcap_signals"): (".mcap",),
}
# Programs give text tables many suffixes.
_TEXT = ("text_table", "text_signals")


def signals_of(path: Path, stack: ExitStack) -> list[Signal]:
    """List the signals of a file, which stays open until `stack` is closed.

    Raises `RecordingError` for a file without readable signals, `RunError` for a missing package.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file. Check the path.")
    if not path.is_file():
        raise RecordingError(f"{path} is not a file. Give the path of each file to import.")
    suffix = path.suffix.lower()
    module, function = next((reader for reader, suffixes in _READERS.items() if suffix in suffixes), _TEXT)
    read: Callable[[Path, ExitStack], list[Signal]] = getattr(import_module(f"daq.extras.importing.{module}"), function)
    try:
        signals = [signal for signal in read(path, stack) if signal.samples > 1]
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise RecordingError(
                f"{gettempdir()}: cannot write the numbers of {path} to a temporary file: {error.strerror}. Free space "
                "on this disk, or name a folder on another disk in the environment variable TMPDIR."
            ) from error
        raise RecordingError(f"cannot read {path}: {error.strerror or error}. Check the file and its disk.") from error
    except MemoryError:
        raise RecordingError(
            f"{path} does not fit into memory. Export it as TDMS, WAV or CSV, which are read in pieces."
        ) from None
    if not signals:
        raise RecordingError(f"{path} contains no samples. Export time histories of at least two samples.")
    return signals
