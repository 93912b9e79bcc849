# The public names and where they live; `__init__.py` imports each when it is first used.

from .foresight.foresee import foresee
from .importing.import_files import import_files
from .measurement.run import RunWarning, record
from .recording.recorder import Recorder
from .recording.recording import Recording, open
from .recording.recovery import recover
from .server.connection import connect

__all__ = [
    "Recorder",
    "Recording",
    "RunWarning",
    "connect",
    "foresee",
    "import_files",
    "open",
    "record",
    "recover",
]
