"""Free vibration from the scene's initial state, without drive."""

from daq.core.excitation.procedure import Procedure
from daq.core.excitation.station import Excitation, Station
from rig.core.scene.excitation import Free

# Length of the windows in which the drive (here zero) is output [s].
_WINDOW_S = 0.1


class FreeProcedure(Procedure["Free"]):
    """A free decay."""

    detection = "start"

    def excite(self, station: Station, test: Free) -> Excitation:
        """Record a free decay."""
        first, total = station.now, station.samples(test.duration)
        while (elapsed := station.now - first) < total:
            yield station.zero_drive(min(station.samples(_WINDOW_S), total - elapsed))
            elapsed = station.now - first
            station.report(elapsed / total, f"{elapsed / station.rate:.1f} s of {test.duration:g} s")
        station.mark("free", first, first + total)


PROCEDURE = FreeProcedure()
