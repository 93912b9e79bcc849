"""Results of all three packages: their base class, frequency responses, uncertainty budgets, numbers as text."""

from rig.core.results.result import Result, complete_style, join_columns, missing_package
from rig.core.results.text import (
    format_decimals,
    format_frequencies,
    format_frequency,
    format_interval,
    format_limited,
    format_number,
    format_percent,
    format_quantity,
    round_to_uncertainty,
)

__all__ = [
    "Result",
    "complete_style",
    "format_decimals",
    "format_frequencies",
    "format_frequency",
    "format_interval",
    "format_limited",
    "format_number",
    "format_percent",
    "format_quantity",
    "join_columns",
    "missing_package",
    "round_to_uncertainty",
]
