"""The table of handlers of remote calls."""

from __future__ import annotations

from collections.abc import Callable

from daq.instrument.devices.measurements import MEASUREMENTS
from daq.server.attributes import attribute_call
from daq.server.calls import channels, devices, samples, scales, session_utilities, tasks, timing
from daq.server.calls.call import Answer, Call
from daq.server.calls.channels import create_input, create_teds_input


def answer_to(name: str) -> Callable[[Call], Answer] | None:
    """Return the handler of a call of the service; None if the instrument does not support the call."""
    for group in (tasks, channels, timing, samples, scales, devices, session_utilities):
        if name in group.CALLS:
            return group.CALLS[name]
    kind = name.replace("ChanWithExcit", "WithExcitChan").removesuffix("Chan")
    for prefix, make in (("CreateTEDSAI", create_teds_input), ("CreateAI", create_input)):
        wanted = kind.removeprefix(prefix)
        if kind.startswith(prefix) and (wanted in MEASUREMENTS or "Bridge" in wanted):
            return make(wanted)
    return attribute_call(name)
