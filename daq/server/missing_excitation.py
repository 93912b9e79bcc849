"""Message for a script that reads a sensor without supply current: hardware would return noise."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress

from daq.instrument.chassis import Chassis
from daq.instrument.settings.channels import Channel


def report_missing_excitation(chassis: Chassis) -> None:
    """Report on stderr, once per input, that a task samples a sensor whose supply is off."""
    reported: set[int] = set()

    def hear(channels: Sequence[Channel]) -> None:
        unfed = [each for each in channels if chassis.terminals.supply(each.row) == 0.0]
        fresh = {each.row: each for each in unfed if each.row not in reported}
        if not fresh:
            return
        reported.update(fresh)
        infos = chassis.bench.channels
        inputs = ", ".join(f"{each.port.name} ({infos[row].name})" for row, each in fresh.items())
        current = next(iter(fresh.values())).module.currents[0]
        # A closed terminal must not cause an error in the client.
        with suppress(OSError):
            print(
                f"note: no excitation for {inputs}: an IEPE sensor without it gives no more than noise; make the "
                "channel with add_ai_accel_chan or add_ai_force_iepe_chan, or set its ai_excit_src to "
                f"ExcitationSource.INTERNAL and its ai_excit_val to {current!r} "
                "(`daq serve SCENE` prints a script that does)",
                file=sys.stderr,
                flush=True,
            )

    chassis.wiring_listeners.append(hear)
