# The public names and where they live; `__init__.py` imports each when it is first used.

from .commands.calls import Results, compare, cost, dampers, export, frf, modes, paper, report
from .commands.presentation.comparison import Comparison
from .core.damper_motion.dampers import Dampers
from .core.decays.free_decay import Decay, decay
from .core.fitting.fit import Fit, fit
from .core.modal.identification import identify
from .core.modal.modes import Modes, mac
from .core.responses.frequency_responses import Response, compliance, frequency_responses, frfs
from .core.signals.profile_check import ProfileCheck, profile
from .core.signals.shock_spectrum import ShockSpectrum, srs
from .core.tracking.backbone import Backbone, backbone
from .core.tracking.continuation import AmplitudeCurve, continuation
from .core.tracking.force_surface import ForceSurface, force_surface
from .extras.formats.export import sep005
from .extras.formats.frf_files import read_frfs
from .extras.formats.mode_files import read_modes

__all__ = [
    "AmplitudeCurve",
    "Backbone",
    "Comparison",
    "Dampers",
    "Decay",
    "Fit",
    "ForceSurface",
    "Modes",
    "ProfileCheck",
    "Response",
    "Results",
    "ShockSpectrum",
    "backbone",
    "compare",
    "compliance",
    "continuation",
    "cost",
    "dampers",
    "decay",
    "export",
    "fit",
    "force_surface",
    "frequency_responses",
    "frf",
    "frfs",
    "identify",
    "mac",
    "modes",
    "paper",
    "profile",
    "read_frfs",
    "read_modes",
    "report",
    "sep005",
    "srs",
]
