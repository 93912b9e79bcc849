"""Free vibration from the scene's initial state, without drive."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.excitation.station import Excitation, Station

if TYPE_CHECKING:
    from rig.scene.excitation import Free

_WINDOW = 0.1


def excite(station: Station, test: Free) -> Excitation:
    """Record a free decay."""
    total = station.samples(test.duration)
    while station.now < total:
        yield station.quiet(min(station.samples(_WINDOW), total - station.now))
        station.report(station.now / total, f"{station.now / station.rate:.1f} s of {test.duration:g} s")
    station.mark("free", 0, total)
