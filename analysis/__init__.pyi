# The public names and where they live; `__init__.py` imports each when it is first used.

from .decays.free_decay import Decay, decay
from .exporting.export import sep005
from .fitting.fit import Fit, fit
from .modal.identification import identify
from .modal.modes import Modes, mac
from .responses.frequency_responses import Response, compliance, frequency_responses, frfs
from .responses.frf_files import read_frfs

__all__ = [
    "Decay",
    "Fit",
    "Modes",
    "Response",
    "compliance",
    "decay",
    "fit",
    "frequency_responses",
    "frfs",
    "identify",
    "mac",
    "read_frfs",
    "sep005",
]
