"""Recordings become compliance, decay, modes, figures and verdicts."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import analysis` stays quick (numba alone takes longer to import than a whole impulse test takes to
# run).
_HOME: dict[str, str] = {
    "Decay": "analysis.ringdown",
    "Frf": "analysis.frf",
    "Modes": "analysis.modal",
    "compliance": "analysis.transfer",
    "decay": "analysis.ringdown",
    "frequency_responses": "analysis.transfer",
    "identify": "analysis.modal",
    "mac": "analysis.modal",
    "sep005": "analysis.export",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'analysis' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
