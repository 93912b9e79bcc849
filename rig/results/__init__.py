"""Results of all three packages: their base class, frequency responses, uncertainty budgets, numbers as text."""

from rig.results.result import Result, joined, missing, styled
from rig.results.text import bounded, frequency_ranges, interval, plainly, rounded

__all__ = [
    "Result",
    "bounded",
    "frequency_ranges",
    "interval",
    "joined",
    "missing",
    "plainly",
    "rounded",
    "styled",
]
