"""Recordings become compliance, decay, modes, figures and verdicts."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import analysis` stays quick (numba alone takes longer to import than a whole impulse test takes to
# run).
_HOME: dict[str, str] = {
    "Decay": "analysis.decays.free_decay",
    "Frf": "analysis.responses.frf",
    "Modes": "analysis.modal.identification",
    "compliance": "analysis.responses.frequency_responses",
    "decay": "analysis.decays.free_decay",
    "frequency_responses": "analysis.responses.frequency_responses",
    "identify": "analysis.modal.identification",
    "mac": "analysis.modal.identification",
    "sep005": "analysis.export.export",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'analysis' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
