"""Names on the instrument: devices, physical channels, terminals, and lists and ranges of them.

The bench holds one chassis, `cDAQ1`, with the inputs in `cDAQ1Mod1` and the output in `cDAQ1Mod2`. Scripts
are written for all kinds of devices, so any of the usual names is taken for it: `Dev1` to `Dev9`, `cDAQ1`
to `cDAQ9` with or without `Mod1` to `Mod8`, `PXI1Slot2` and the like. Each of them offers all inputs and
the output. Inputs under different names are separate modules on the same sensors (a T-piece in every
cable), so that tasks which use several devices find them; the shaker is one, whatever its output is called.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from daq.instrument.errors import DaqError, DAQmxErrors

CHASSIS, INPUTS, OUTPUTS = "cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"

# What a range stands for, at most, as with the driver.
MOST_NAMES = 14_999

_DEVICE = re.compile(r"(Dev[1-9]|cDAQ[1-9](Mod[1-8])?|PXI[1-9]Slot\d{1,2})", re.IGNORECASE)


class Port(NamedTuple):
    """A physical channel: device name, kind of port (`ai`, `ao`), number."""

    device: str
    kind: str
    number: int


def check_device(name: str) -> str:
    """Give back a device name without its leading slash.

    Raises
    ------
    DaqError
        With -200220, if no device goes by that name.
    """
    bare = name.strip().lstrip("/")
    if not _DEVICE.fullmatch(bare):
        raise DaqError(
            f"there is no device {name!r}: the bench has {CHASSIS} with {INPUTS} (inputs) and {OUTPUTS} "
            "(output), "
            "which also go by the usual names Dev1, Dev2, ..., cDAQ1Mod1, ..., PXI1Slot2, ...",
            DAQmxErrors.INVALID_DEVICE_ID,
        )
    return bare


def parse_port(name: str) -> Port:
    """Take a physical channel's name apart.

    Raises
    ------
    DaqError
        With -200220 for an unknown device, -200170 for something that is not a channel of it.

    Examples
    --------
    >>> parse_port("cDAQ1Mod1/ai3")
    Port(device='cDAQ1Mod1', kind='ai', number=3)
    """
    device, _, port = name.strip().lstrip("/").partition("/")
    match = re.fullmatch(r"([A-Za-z]+)(\d+)", port)
    check_device(device)
    if not match:
        raise DaqError(
            f"{name!r} is not a physical channel: expected a device and a channel, such as {INPUTS}/ai0",
            DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST,
        )
    return Port(device, match[1].lower(), int(match[2]))


def unflatten(names: str) -> list[str]:
    """Expand a list with ranges.

    Raises
    ------
    DaqError
        With -200498, if a range is not of the form `ai0:3` or `Dev1/ai0:Dev1/ai3`, or too long.

    Examples
    --------
    >>> unflatten("Dev1/ai0:2, Dev1/ai7")
    ['Dev1/ai0', 'Dev1/ai1', 'Dev1/ai2', 'Dev1/ai7']
    >>> unflatten("a03:01")
    ['a03', 'a02', 'a01']
    """
    found: list[str] = []
    for item in (part.strip() for part in names.split(",")):
        if ":" in item:
            found += _expand(item)
        elif item:
            found.append(item)
    return found


def _expand(item: str) -> list[str]:
    match = re.fullmatch(r"(.*?)(\d+):(.*?)(\d+)", item)
    if not match or (match[3] and match[3].lower() != match[1].lower()):
        raise DaqError(
            f"{item!r} is not a range of channels: expected a number on both sides of the colon, such as "
            "Dev1/ai0:3",
            DAQmxErrors.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING,
        )
    first, last = int(match[2]), int(match[4])
    if abs(last - first) >= MOST_NAMES:
        raise DaqError(
            f"{item!r} is a range of {abs(last - first) + 1} names: expected {MOST_NAMES} at most",
            DAQmxErrors.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING,
        )
    width = len(match[2]) if match[2].startswith("0") else 0
    step = 1 if last >= first else -1
    return [f"{match[1]}{number:0{width}d}" for number in range(first, last + step, step)]


def flatten(names: list[str]) -> str:
    """Join names into one string, as the driver writes lists.

    Examples
    --------
    >>> flatten(["Dev1/ai0", "Dev1/ai1", "Dev1/ai2", "drive"])
    'Dev1/ai0:2,drive'
    """
    runs: list[tuple[str, str, str]] = []
    for name in (each for item in names for each in unflatten(item)):
        match = re.fullmatch(r"(.*?)(\d+)", name)
        base, digits = (match[1], match[2]) if match else (name, "")
        if runs and digits and runs[-1][0] == base and runs[-1][2]:
            previous = runs[-1][2]
            following = f"{int(previous) + 1:0{len(previous) if previous.startswith('0') else 0}d}"
            if following == digits:
                runs[-1] = (base, runs[-1][1], digits)
                continue
        runs.append((base, digits, digits))
    return ",".join(f"{base}{first}" + (f":{last}" if first != last else "") for base, first, last in runs)
