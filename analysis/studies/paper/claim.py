"""A claim of Inoue, Yokomichi, Hiraki (2011), with the evidence from the reproduction and the verdict."""

from dataclasses import dataclass
from typing import NamedTuple


class Evidence(NamedTuple):
    """A sentence with results of the reproduction."""

    text: str
    parts: tuple[str, ...]  # names of the parts that produced the results


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and its verdict."""

    name: str  # C1 to C7, or a title for results beyond the paper
    text: str  # the claim
    evidence: tuple[Evidence, ...]
    verdict: str  # "holds", "holds for these parameters", "holds in part" or "does not hold", with the reason
    figures: tuple[str, ...]  # names of figures, as in `page.CAPTIONS`
