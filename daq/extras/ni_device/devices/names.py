"""Names of devices and channels, and lists and ranges of them.

A name of a device on the bench selects that device. Any other name that NI's driver typically assigns (`Dev1`,
`cDAQ1Mod1`, `cDAQ9189-1D91958Mod1`, `PXI1Slot2`) selects a device with all inputs and outputs, so scripts for
other hardware run unchanged. Such devices are separate modules on the same sensors, as with a T-piece in every cable;
an output is the same under all names.
"""

import re
from typing import NamedTuple

from daq.extras.ni_device.errors import Code, DaqError

# Maximum number of names in a range, as in the driver.
MAX_NAMES = 14_999

# Names that NI's driver assigns to devices.
ASSIGNED_BY_DRIVER = re.compile(r"(Dev\d+|cDAQ\w*(-\w+)?|PXI\d+Slot\d+)", re.IGNORECASE)


class Port(NamedTuple):
    """A physical channel: device name, direction (`ai`, `ao`), number."""

    device: str
    direction: str
    number: int

    @property
    def name(self) -> str:
        """Name of the physical channel."""
        return f"{self.device}/{self.direction}{self.number}"


def parse_port(name: str) -> Port:
    """Return the physical channel with a name; raise `DaqError` -200170 if there is no such physical channel.

    >>> parse_port("cDAQ9189-1D91958Mod1/ai3")
    Port(device='cDAQ9189-1D91958Mod1', direction='ai', number=3)
    """
    device, _, port = name.strip().lstrip("/").partition("/")
    match = re.fullmatch(r"([A-Za-z]+)(\d{1,9})", port)
    if not match:
        raise DaqError(
            f"{name!r} is not a physical channel. Give a device and a channel, such as cDAQ1Mod1/ai0.",
            Code.PHYSICAL_CHAN_DOES_NOT_EXIST,
        )
    return Port(device, match[1].lower(), int(match[2]))


def unflatten(names: str) -> list[str]:
    """Expand a list of names and ranges, separated by commas, to the list of all names.

    Raises `DaqError` -200498 if a range is not of the form `ai0:3` or `Dev1/ai0:Dev1/ai3`, or is too long.

    >>> unflatten("Dev1/ai0:2, Dev1/ai7")
    ['Dev1/ai0', 'Dev1/ai1', 'Dev1/ai2', 'Dev1/ai7']
    >>> unflatten("a03:01")
    ['a03', 'a02', 'a01']
    """
    expanded: list[str] = []
    for item in (part.strip() for part in names.split(",")):
        if ":" in item:
            expanded += _expand(item)
        elif item:
            expanded.append(item)
        if len(expanded) > MAX_NAMES:
            raise DaqError(
                f"a list has more than {MAX_NAMES} names. Shorten it.", Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING
            )
    return expanded


def _expand(item: str) -> list[str]:
    """Return the names from the first to the last of a range, such as ai0 to ai3, or ai3 to ai0."""
    match = re.fullmatch(r"(.*?)(\d{1,9}):(.*?)(\d{1,9})", item)
    if not match or (match[3] and match[3].lower() != match[1].lower()):
        raise DaqError(
            f"{item!r} is not a range of channels. Give a number on both sides of the colon, such as Dev1/ai0:3.",
            Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING,
        )
    first, last = int(match[2]), int(match[4])
    if abs(last - first) >= MAX_NAMES:
        raise DaqError(
            f"{item!r} has {abs(last - first) + 1} names; the maximum is {MAX_NAMES}. Shorten the range.",
            Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING,
        )
    n_digits = len(match[2]) if match[2].startswith("0") else 0
    step = 1 if last >= first else -1
    return [f"{match[1]}{number:0{n_digits}d}" for number in range(first, last + step, step)]


def numbered(name: str, count: int) -> list[str]:
    """Return names of `count` channels, numbered from 0 or from the number at the end of the given name.

    >>> numbered("acc", 3), numbered("acc09", 3), numbered("acc", 1)
    (['acc0', 'acc1', 'acc2'], ['acc09', 'acc10', 'acc11'], ['acc'])
    """
    if count == 1:
        return [name]
    match = re.fullmatch(r"(.*?)(\d{0,9})", name, re.DOTALL)
    assert match is not None
    first, n_digits = int(match[2] or 0), len(match[2])
    return [f"{match[1]}{number:0{n_digits}d}" for number in range(first, first + count)]
