"""Values of settings that the instrument supports; names and numbers are those of NI-DAQmx."""

from enum import IntEnum
from typing import TypeVar

from daq.extras.ni_device.errors import invalid_value

Member = TypeVar("Member", bound=IntEnum)


def enum_member(values: type[Member], value: int, setting: str) -> Member:
    """Return the named value of a number. Raises `DaqError` -200077, which names the setting, for an unknown number."""
    if value not in list(values):
        names = ", ".join(f"{member.name} ({int(member)})" for member in values)
        raise invalid_value(f"{setting} {value} is not supported. Choose {names}.")
    return values(value)


SampleMode = IntEnum("SampleMode", {"FINITE": 10178, "CONTINUOUS": 10123})
TimingType = IntEnum("TimingType", {"SAMPLE_CLOCK": 10388, "ON_DEMAND": 10390})
Slope = IntEnum("Slope", {"RISING": 10280, "FALLING": 10171})


class TriggerType(IntEnum):
    """Kind of trigger."""

    NONE = 10230
    ANALOG_EDGE = 10099
    ANALOG_MULTI_EDGE = 16108
    ANALOG_WINDOW = 10103
    DIGITAL_EDGE = 10150
    DIGITAL_PATTERN = 10398
    TIME = 15996


WindowCondition = IntEnum("WindowCondition", {"ENTERING": 10163, "LEAVING": 10208})
# Whether unread samples may be overwritten, and whether an output repeats its buffer.
Overwrite = IntEnum("Overwrite", {"ALLOWED": 10252, "NOT_ALLOWED": 10159})
Regeneration = IntEnum("Regeneration", {"ALLOWED": 10097, "NOT_ALLOWED": 10158})


class RelativeTo(IntEnum):
    """Sample relative to which a read position is given."""

    FIRST_SAMPLE = 10424
    CURRENT_READ_POSITION = 10425
    REFERENCE_TRIGGER = 10426
    FIRST_PRETRIGGER_SAMPLE = 10427
    MOST_RECENT_SAMPLE = 10428
    CURRENT_WRITE_POSITION = 10430


LoggingMode = IntEnum("LoggingMode", {"OFF": 10231, "LOG": 15844, "LOG_AND_READ": 15842})
# Whether a log is appended to an existing file, or replaces it.
LoggingOperation = IntEnum(
    "LoggingOperation", {"OPEN": 10437, "OPEN_OR_CREATE": 15846, "CREATE_OR_REPLACE": 15847, "CREATE": 15848}
)


class TaskMode(IntEnum):
    """Requested transition of a task to another state."""

    START = 0
    STOP = 1
    VERIFY = 2
    COMMIT = 3
    RESERVE = 4
    UNRESERVE = 5
    ABORT = 6


Coupling = IntEnum("Coupling", {"AC": 10045, "DC": 10050, "GND": 10066})
# Source of a sensor's supply.
Excitation = IntEnum("Excitation", {"INTERNAL": 10200, "EXTERNAL": 10167, "NONE": 10230})
# Terminal configuration of an input.
TerminalConfiguration = IntEnum(
    "TerminalConfiguration",
    {"DEFAULT": -1, "RSE": 10083, "NRSE": 10078, "DIFFERENTIAL": 10106, "PSEUDO_DIFFERENTIAL": 12529},
)
# Signals that can be exported, or for which events can be registered.
Signal = IntEnum(
    "Signal", {"SAMPLE_CLOCK": 12487, "REFERENCE_TRIGGER": 12490, "START_TRIGGER": 12491, "SAMPLE_COMPLETE": 12530}
)
# Events whose time can be queried.
TimestampEvent = IntEnum("TimestampEvent", {"START_TRIGGER": 12491, "REFERENCE_TRIGGER": 12490, "FIRST_SAMPLE": 16130})
# Samples that an event counts: acquired or generated.
EverySamples = IntEnum("EverySamples", {"ACQUIRED": 1, "TRANSFERRED": 2})

# Units that a custom scale, or the electronic data sheet (TEDS) of the sensor, defines.
FROM_CUSTOM_SCALE, FROM_TEDS = 10065, 12516
