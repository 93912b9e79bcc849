# The public names and where they live; `__init__.py` imports each when it is first used.

from .calls import Results, compare, cost, dampers, export, frf, modes, paper, report
from .damper_motion.dampers import Dampers
from .decays.free_decay import Decay, decay
from .exporting.export import sep005
from .fitting.fit import Fit, fit
from .modal.identification import identify
from .modal.modes import Modes, mac
from .presentation.comparison import Comparison
from .responses.frequency_responses import Response, compliance, frequency_responses, frfs
from .responses.frf_files import read_frfs

__all__ = [
    "Comparison",
    "Dampers",
    "Decay",
    "Fit",
    "Modes",
    "Response",
    "Results",
    "compare",
    "compliance",
    "cost",
    "dampers",
    "decay",
    "export",
    "fit",
    "frequency_responses",
    "frf",
    "frfs",
    "identify",
    "mac",
    "modes",
    "paper",
    "read_frfs",
    "report",
    "sep005",
]
