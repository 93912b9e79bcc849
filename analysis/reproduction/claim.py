"""A claim of the paper, with its evidence and verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Evidence(NamedTuple):
    """A sentence with numbers, and the parts of the reproduction that produced them."""

    text: str
    parts: tuple[str, ...]


@dataclass(frozen=True)
class Claim:
    """A claim and its verdict."""

    name: str  # C1 to C7, or a title for results beyond the paper
    text: str
    evidence: tuple[Evidence, ...]
    verdict: str  # "holds", "holds for these parameters", "holds in part" or "does not hold", with the reason
    figures: tuple[str, ...]
