# The public names and where they live; `__init__.py` imports each when it is first used.

from .bench_page.bench import bench
from .compiling import warm_up
from .foresight.foresee import foresee
from .importing.import_files import import_, import_files
from .measurement.run import RunWarning, record
from .recording.recorder import Recorder
from .recording.recording import Recording, open
from .recording.recovery import recover
from .server.connection import connect
from .server.script import run
from .server.serve import serve
from .viewing.description import Info, info
from .viewing.show import replay

__all__ = [
    "Info",
    "Recorder",
    "Recording",
    "RunWarning",
    "bench",
    "connect",
    "foresee",
    "import_",
    "import_files",
    "info",
    "open",
    "record",
    "recover",
    "replay",
    "run",
    "serve",
    "warm_up",
]
