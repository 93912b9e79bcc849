"""MATLAB files, read in a process of their own: scipy's reader can bring its process down over a damaged file.

Run as a program, it writes what is in the file that its one argument names.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

from rig.errors import RecordingError, RunError

_NO_HDF5 = "needs h5py"


def matlab_arrays(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB file.

    Raises
    ------
    RecordingError
        If it is none or damaged.
    RunError
        If it is of version 7.3 and h5py is not installed.
    """
    program = [sys.executable, "-m", __name__, str(path.resolve())]
    reader = subprocess.run(program, capture_output=True, check=False)
    if reader.returncode < 0 or not reader.stdout:
        raise RecordingError(f"{path} is damaged: reading it ended with code {reader.returncode}")
    content: dict[str, Any] | str = pickle.loads(reader.stdout)
    if content == _NO_HDF5:
        raise RunError(
            f"{path} is a MATLAB file of version 7.3 (HDF5), which needs the package h5py: pip install "
            "'shotrig[matlab]'; or in MATLAB: save(name, ..., '-v7')"
        )
    if isinstance(content, str):
        raise RecordingError(f"{path} {content}")
    return content


def _read(name: str) -> dict[str, Any] | str:
    """Read the variables, or say what is wrong with the file."""
    from scipy.io import loadmat

    try:
        content = loadmat(name, squeeze_me=True, struct_as_record=True, chars_as_strings=True)
    except NotImplementedError:
        return _read_hdf5(name)
    except MemoryError:
        return "states an array that does not fit into memory; the file is damaged"
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        return f"is no MATLAB file, or it is damaged: {type(error).__name__}: {error}"[:300]
    return {key: value for key, value in content.items() if key[:2] != "__"}


def _read_hdf5(name: str) -> dict[str, Any] | str:
    from daq.importing.matlab_hdf5 import hdf5_variables

    try:
        return hdf5_variables(name)
    except ImportError:
        return _NO_HDF5
    except MemoryError:
        return "holds more than fits into memory; save the channels one by one, or as TDMS or WAV"
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        return f"is damaged: {type(error).__name__}: {error}"[:300]


if __name__ == "__main__":
    pickle.dump(_read(sys.argv[1]), sys.stdout.buffer, protocol=5)
