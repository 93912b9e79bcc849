"""Example script that reads the inputs of a bench; sensors without excitation current are reported."""

import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from itertools import groupby

from daq.core.excitation.sensor_settling import longest_duration
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.settings.channels import Channel
from rig.core.scene.scene import STANDARD_GRAVITY

# Limits of a channel, relative to full scale, which rounded limits must not exceed.
_LIMIT_RATIO = 1 - 1e-5
# By quantity: function of nidaqmx, unit of readings, factor from V per SI unit to the unit of sensitivity (mV/g, mV/N).
_SENSORS = {
    "acceleration": ("add_ai_accel_chan", "AccelUnits.METERS_PER_SECOND_SQUARED", 1e3 * STANDARD_GRAVITY),
    "force": ("add_ai_force_iepe_chan", "ForceUnits.NEWTONS", 1e3),
}
# Placeholder for the names of physical channels in a statement.
_PHYSICAL_CHANNEL = "PHYSICAL_CHANNEL"
# Classes of nidaqmx.constants that the script imports if it uses them.
_CONSTANTS = ("AccelUnits", "AcquisitionType", "Coupling", "ExcitationSource", "ForceUnits")


def starter_script(chassis: Chassis, channel: str) -> list[str]:
    """Return the lines of a script that reads the inputs of a bench in their units; the first line is empty.

    One task reads all modules of a chassis. If there are several separate devices, the script reads the first.
    `channel` is the expression for the connection to the server.
    """
    modules = [module for name in chassis.devices.names if (module := chassis.devices.module(name)).inputs]
    first = modules[0]
    in_task = [module for module in modules if module is first or (module.chassis and module.chassis == first.chassis)]
    statements: list[str] = []
    for module in in_task:
        # Neighboring inputs with equal settings are created by one statement.
        numbered = [(_create_channel(chassis, module, index), number) for number, index in enumerate(module.inputs)]
        for statement, group in groupby(numbered, key=lambda pair: pair[0]):
            numbers = [number for _, number in group]
            number_range = f"{numbers[0]}:{numbers[-1]}" if len(numbers) > 1 else f"{numbers[0]}"
            lines = statement.replace(_PHYSICAL_CHANNEL, f"{module.name}/ai{number_range}").splitlines()
            statements += [f"    {line}" for line in lines]
    infos = [chassis.bench.channels[index] for module in in_task for index in module.inputs]
    statements += _read_samples(chassis.bench.rate, math.ceil(longest_duration(infos)))
    used_constants = [constant for constant in _CONSTANTS if any(f"{constant}." in line for line in statements)]
    return [
        "",
        "import grpc, nidaqmx, numpy",
        *([f"from nidaqmx.constants import {', '.join(used_constants)}"] if used_constants else []),
        f"channel = {channel}",
        'options = nidaqmx.GrpcSessionOptions(channel, session_name="")',
        "with nidaqmx.Task(grpc_options=options) as task:",
        *statements,
        "print(data)",
    ]


def _read_samples(rate: float, settling_s: int) -> list[str]:
    """Return the statements that read 1000 samples at a rate in Hz after the sensors have settled."""
    if not settling_s:
        return [
            f"    task.timing.cfg_samp_clk_timing({rate!r}, samps_per_chan=1000)",
            "    data = numpy.array(task.read(1000))",
        ]
    return [
        f"    task.timing.cfg_samp_clk_timing({rate!r}, sample_mode=AcquisitionType.CONTINUOUS)",
        f"    # After power-on, the bias of the sensors settles for up to {settling_s} s: discard these samples.",
        f"    for second in range({settling_s}):",
        f"        task.read({math.ceil(rate)})",
        "    data = numpy.array(task.read(1000))",
    ]


def _create_channel(chassis: Chassis, module: Module, bench_index: int) -> str:
    """Return the statements that create an input, with a placeholder for its physical channel."""
    info = chassis.bench.channels[bench_index]
    needs_excitation, current = chassis.terminals.supply(bench_index) is not None, module.currents[0]
    if info.quantity in _SENSORS:
        function, unit, factor = _SENSORS[info.quantity]
        supply = f"INTERNAL, current_excit_val={current!r}" if needs_excitation else "NONE"
        return (
            f'task.ai_channels.{function}(\n    "{_PHYSICAL_CHANNEL}"{_limits(info, info.sensitivity)}, units={unit},\n'
            f"    sensitivity={info.sensitivity * factor:.9g}, current_excit_source=ExcitationSource.{supply})"
        )
    call = f'task.ai_channels.add_ai_voltage_chan("{_PHYSICAL_CHANNEL}"{_limits(info, 1.0)})'
    if not needs_excitation:
        return call
    # A sensor with an integrating amplifier is read as a voltage, whose call has no argument for the excitation.
    lines = [
        f"voltage_channel = {call}",
        "voltage_channel.ai_excit_src = ExcitationSource.INTERNAL",
        f"voltage_channel.ai_excit_val = {current!r}",
    ]
    if module.supply_coupling == "AC":
        lines.append("voltage_channel.ai_coupling = Coupling.AC")
    return "\n".join(lines)


def _limits(info: ChannelInfo, volts_per_unit: float) -> str:
    """Return the arguments of a call that set a channel's limits to its full range; empty without a range."""
    if info.range is None:
        return ""
    limit = info.range if volts_per_unit == 1.0 else _LIMIT_RATIO * info.range / volts_per_unit
    return f", min_val={-limit:.6g}, max_val={limit:.6g}"


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
                f"ExcitationSource.INTERNAL and its ai_excit_val to {current!r} "
                "(see the script that `daq serve SCENE` prints).",
                file=sys.stderr,
                flush=True,
            )

    chassis.conditioning_listeners.append(check)
