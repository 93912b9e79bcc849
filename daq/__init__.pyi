# The public names and where they live; `__init__.py` imports each when it is first used.

from .face.task import Task
from .instrument.connection import connect
from .instrument.errors import DaqError
from .measurement.run import RunWarning, record
from .recording.recorder import Recorder
from .recording.recording import Recording, open
from .recording.recovery import recover

__all__ = ["DaqError", "Recorder", "Recording", "RunWarning", "Task", "connect", "open", "record", "recover"]
