"""Report of sensors that a task samples without their excitation current."""

import sys
from collections.abc import Sequence
from contextlib import suppress

from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.settings.channels import Channel


def report_missing_excitation(chassis: Chassis) -> None:
    """From now on, report once per input on stderr that a task samples a sensor without excitation."""
    reported: set[int] = set()

    def check(channels: Sequence[Channel]) -> None:
        unexcited = [channel for channel in channels if chassis.terminals.supply(channel.bench_index) == 0.0]
        unreported = {channel.bench_index: channel for channel in unexcited if channel.bench_index not in reported}
        if not unreported:
            return
        reported.update(unreported)
        infos = chassis.bench.channels
        inputs = ", ".join(f"{channel.port.name} ({infos[index].name})" for index, channel in unreported.items())
        current = next(iter(unreported.values())).module.currents[0]
        # An error of a closed console must not reach the client.
        with suppress(OSError):
            print(
                f"note: no excitation for {inputs}: without it, an IEPE sensor returns only noise. Create the channel "
                "with add_ai_accel_chan or add_ai_force_iepe_chan, or set its ai_excit_src to "
                f"ExcitationSource.INTERNAL and its ai_excit_val to {current!r}.",
                file=sys.stderr,
                flush=True,
            )

    chassis.conditioning_listeners.append(check)
