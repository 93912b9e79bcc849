"""MATLAB files, read in a process of their own: scipy's reader can bring its process down over a damaged file.

Run as a program, it writes what is in the file that its one argument names.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

from rig.errors import RecordingError


def matlab_arrays(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB file of version 4 to 7.2.

    Raises
    ------
    RecordingError
        If it is none, damaged, or of version 7.3.
    """
    program = [sys.executable, "-m", __name__, str(path.resolve())]
    reader = subprocess.run(program, capture_output=True, check=False)
    if reader.returncode < 0 or not reader.stdout:
        raise RecordingError(f"{path} is damaged: reading it ended with code {reader.returncode}")
    content: dict[str, Any] | str = pickle.loads(reader.stdout)
    if isinstance(content, str):
        raise RecordingError(f"{path} {content}")
    return content


def _read(name: str) -> dict[str, Any] | str:
    """Read the variables, or say what is wrong with the file."""
    from scipy.io import loadmat

    try:
        content = loadmat(name, squeeze_me=True, struct_as_record=True, chars_as_strings=True)
    except NotImplementedError:
        return "is a MATLAB file of version 7.3 (HDF5), which is not read; in MATLAB: save(name, ..., '-v7')"
    except MemoryError:
        return "states an array that does not fit into memory; the file is damaged"
    except Exception as error:
        # The reader meets damage as whatever it happens to lead to.
        return f"is no MATLAB file, or it is damaged: {type(error).__name__}: {error}"[:300]
    return {key: value for key, value in content.items() if key[:2] != "__"}


if __name__ == "__main__":
    pickle.dump(_read(sys.argv[1]), sys.stdout.buffer, protocol=5)
