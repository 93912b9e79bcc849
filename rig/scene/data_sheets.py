"""Data sheets of common sensors and modules, which a scene names as `preset`."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

from rig.errors import SceneError
from rig.scene.quantities import FREQUENCY, parse


@dataclass(frozen=True)
class DataSheet:
    """A part's data sheet."""

    name: str  # Maker and model
    kind: str
    """accelerometer, hammer or converter."""
    sources: tuple[str, ...]
    """Where the figures come from."""
    settings: dict[str, Any]
    """Figures by the scene's keys, as a scene file has them."""
    clock: float | None
    largest_divisor: int
    """A module's clock [Hz] and by how much it can be divided; None: any rate."""

    def divided(self, rate: float) -> float:
        """Give the rate of its samples where one is asked for: the next above it that its clock can be divided to.

        Raises
        ------
        SceneError
            If it cannot sample that fast.

        Examples
        --------
        >>> part("NI 9234", "converter").divided(8000.0)
        8533.333333333334
        """
        if self.clock is None:
            return rate
        # A rate that was printed with a few digits still means the one it was rounded from.
        divisor = int(self.clock / rate * (1.0 + 1e-4))
        if divisor < 1:
            raise SceneError(
                f"got {rate:g} Hz; expected {self.clock / self.largest_divisor:g} to {self.clock:g} Hz, which is "
                f"what {self.name} samples at"
            )
        return self.clock / min(divisor, self.largest_divisor)


@cache
def parts() -> dict[str, DataSheet]:
    """List the parts there are, by name.

    >>> sorted(parts())
    ['NI 9234', 'PCB 086C03', 'PCB 352C33']
    """
    found = {}
    for file in files("rig.scene").joinpath("data", "presets").iterdir():
        if not file.name.endswith(".yaml"):
            continue
        sheet = yaml.safe_load(file.read_text(encoding="utf-8"))
        clock = sheet.get("clock", {})
        found[sheet["part"]] = DataSheet(
            sheet["part"],
            sheet["kind"],
            tuple(sheet["sources"]),
            sheet["settings"],
            parse(clock["frequency"], FREQUENCY) if clock else None,
            clock.get("largest_divisor", 1),
        )
    return found


def part(name: str, kind: str) -> DataSheet:
    """Find a part; capitals, spaces and hyphens do not matter.

    Raises
    ------
    SceneError
        If there is none of that name and kind.
    """
    known = {_plain(each.name): each for each in parts().values() if each.kind == kind}
    if _plain(name) in known:
        return known[_plain(name)]
    names = sorted(each.name for each in known.values())
    near = get_close_matches(_plain(name), known, n=1)
    hint = f'; did you mean "{known[near[0]].name}"?' if near else ""
    raise SceneError(f'unknown {kind} preset "{name}"; there is {", ".join(names)}{hint}')


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())
