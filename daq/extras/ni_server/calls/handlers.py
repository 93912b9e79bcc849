"""Handlers of remote calls; a call that no device supports returns the error of real hardware."""

import re
from collections.abc import Callable
from typing import NoReturn

from daq.extras.ni_device.devices.measurements import MEASUREMENTS
from daq.extras.ni_device.devices.names import parse_port, unflatten
from daq.extras.ni_device.errors import Code, DaqError, unsupported
from daq.extras.ni_server.attributes import attribute_handler
from daq.extras.ni_server.calls import channels, samples, settings, tasks
from daq.extras.ni_server.calls.call import Call, Handler

# Patterns of calls that create inputs, and of calls that create any channel (A: analog, C: counter, D: digital).
_CREATE_INPUT = re.compile(r"Create(TEDS)?AI(\w+)Chan")
_CREATE_CHANNEL = re.compile(r"Create(TEDS)?([ACD][IO])(\w*Chan\w*)")
# Boundaries between the words of a call's name.
_WORDS = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[a-z])(?=[0-9])|(?<=[A-Z])(?=[A-Z][a-z])")


def handler_of(name: str) -> Handler | None:
    """Return the handler of a call of the service; None if the instrument does not support the call."""
    for group in (tasks, channels, settings, samples):
        if name in group.CALLS:
            return group.CALLS[name]
    create_input = _CREATE_INPUT.fullmatch(name)
    if create_input and create_input[2] in MEASUREMENTS:
        return channels.create_input(MEASUREMENTS[create_input[2]], has_teds=bool(create_input[1]))
    return attribute_handler(name)


def script_function(method: str) -> str:
    """Return the name by which users know a call: a function of the package nidaqmx, or of the C driver.

    >>> script_function("CreateTEDSAIRTDChan"), script_function("ReadDigitalU32")
    ('add_teds_ai_rtd_chan', 'DAQmxReadDigitalU32')
    """
    create_channel = _CREATE_CHANNEL.fullmatch(method)
    if create_channel:
        words = filter(None, (create_channel[1], create_channel[2], _WORDS.sub("_", create_channel[3])))
        return f"add_{'_'.join(words).lower()}"
    return _WORDS.sub("_", method).lower() if method.startswith("Cfg") else f"DAQmx{method}"


def rejection(method: str) -> Callable[[Call], NoReturn]:
    """Return the handler of a call that the instrument does not support.

    It raises `DaqError` -200220 for a device that is not on the bench, -200170 for a counter or a digital line, -200431
    for a measurement that no input supports, and -200452 for anything else.
    """
    function = script_function(method)

    def reject(call: Call) -> NoReturn:
        fields, modules = call.fields, call.instrument.chassis.devices
        for name in ("lines", "counter"):
            if name in fields:
                module = modules.module(fields[name])
                raise DaqError(
                    f"{function}: {module.name} has no {fields[name]!r}. Use its analog inputs and outputs.",
                    Code.PHYSICAL_CHAN_DOES_NOT_EXIST,
                )
        terminals = next((fields[name] for name in fields if name.endswith("physical_channel")), "")
        for terminal in unflatten(terminals):
            port = parse_port(terminal)
            module = modules.module(port.device)
            module.bench_index(port.direction, port.number)  # The lookup raises an error if the channel does not exist.
            raise module.unsupported_measurement_error(f"{port.name}: {function}")
        raise unsupported(function)

    return reject
