"""Results of all three packages: their base class, frequency responses, uncertainty budgets, numbers as text."""

from rig.results.result import Result, joined, missing, styled
from rig.results.text import bounded, frequency_ranges, plainly, rounded

__all__ = ["Result", "bounded", "frequency_ranges", "joined", "missing", "plainly", "rounded", "styled"]
