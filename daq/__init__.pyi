# The public names and where they live; `__init__.py` imports each when it is first used.

from .commands.compiling import warm_up
from .core.measurement.run import RunWarning, record
from .core.prediction.foresee import foresee
from .core.recording.recorder import Recorder
from .core.recording.recording import Recording, open
from .core.recording.recovery import recover
from .extras.bench_page.bench import bench
from .extras.importing.import_files import import_, import_files
from .extras.ni_server.connection import connect
from .extras.ni_server.script import run
from .extras.ni_server.serve import serve
from .extras.viewer.description import Info, info
from .extras.viewer.show import replay

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
