"""MATLAB files, read in a process of their own: scipy's reader can bring its process down over a damaged file.

Run as a program, it writes the content of the file that its first argument names.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from rig.errors import RecordingError, RunError
from rig.numerics.memory import ALLOWED, PROGRAM, most

_NO_HDF5, _TOO_MUCH = "needs h5py", "needs more memory"


def matlab_arrays(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB file.

    Raises `RecordingError` for a damaged file, `RunError` for version 7.3 without h5py.
    """
    memory = str(int(max(most() - PROGRAM, most() / 2)))
    # Modules are found where this process finds them: -m alone would look in the user's folder first.
    program = [sys.executable, "-P", "-m", __name__, str(path.resolve()), memory]
    here = {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)}
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=here) as reader:
        assert reader.stdout is not None
        try:
            content: dict[str, Any] | str = pickle.load(reader.stdout)
        except (EOFError, pickle.UnpicklingError):
            code = reader.wait()
            raise RecordingError(f"{path} is damaged: reading it ended with code {code}") from None
    if content == _NO_HDF5:
        raise RunError(
            f"{path} is a MATLAB file of version 7.3 (HDF5), which needs the package h5py: pip install "
            "'shotrig[matlab]'; or in MATLAB: save(name, ..., '-v7')"
        )
    if content == _TOO_MUCH:
        raise RecordingError(
            f"{path}: importing it takes more than the {most() / 1e9:.3g} GB of memory that are allowed. Save the "
            f"channels one by one, or as TDMS or WAV, or allow more: {ALLOWED}=8GB in the environment."
        )
    if isinstance(content, str):
        raise RecordingError(f"{path} {content}")
    return content


def _read(name: str, memory: int) -> dict[str, Any] | str:
    """Read the variables within a memory in bytes, or give an error text."""
    from scipy.io import loadmat

    _limit(memory)
    try:
        try:
            content = loadmat(name, squeeze_me=True, struct_as_record=True, chars_as_strings=True)
        except NotImplementedError:
            from daq.importing.matlab_hdf5 import hdf5_variables

            return hdf5_variables(name)
    except ImportError:
        return _NO_HDF5
    except MemoryError:
        return _TOO_MUCH
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        return f"is not a MATLAB file, or it is damaged: {type(error).__name__}: {error}"[:300]
    return {key: value for key, value in content.items() if key[:2] != "__"}


def _limit(memory: int) -> None:
    """Limit the memory of this process: a packed file holds a thousand times its size."""
    try:
        import resource
    except ImportError:
        # Not every system can limit a process.
        return
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))


if __name__ == "__main__":
    pickle.dump(_read(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer, protocol=5)
