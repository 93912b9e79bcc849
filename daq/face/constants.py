"""Constants of the NI-DAQmx interface that the instrument uses; names and numbers are the driver's."""

from __future__ import annotations

from enum import Enum, Flag

AUTO = -1
CFG_DEFAULT = -1
DEFAULT = -1
READ_ALL_AVAILABLE = -1
WAIT_INFINITELY = -1.0


class AccelSensitivityUnits(Enum):
    """Units of an accelerometer's sensitivity."""

    MILLIVOLTS_PER_G = 12509
    VOLTS_PER_G = 12510


class AccelUnits(Enum):
    """Units in which accelerations are read."""

    G = 10186
    METERS_PER_SECOND_SQUARED = 12470
    INCHES_PER_SECOND_SQUARED = 12471
    FROM_CUSTOM_SCALE = 10065


class AcquisitionType(Enum):
    """How many samples a task takes."""

    FINITE = 10178
    CONTINUOUS = 10123
    HW_TIMED_SINGLE_POINT = 12522


class BusType(Enum):
    """How a device is attached."""

    USB = 12586
    COMPACT_DAQ = 14637
    UNKNOWN = 12588


class ChannelType(Enum):
    """What a channel does."""

    ANALOG_INPUT = 10100
    ANALOG_OUTPUT = 10102
    DIGITAL_INPUT = 10151
    DIGITAL_OUTPUT = 10153
    COUNTER_INPUT = 10131
    COUNTER_OUTPUT = 10132


class Coupling(Enum):
    """Input coupling."""

    AC = 10045
    DC = 10050
    GND = 10066


class Edge(Enum):
    """Edge of a digital signal."""

    RISING = 10280
    FALLING = 10171


class EveryNSamplesEventType(Enum):
    """Which buffer an every-N-samples event watches."""

    ACQUIRED_INTO_BUFFER = 1
    TRANSFERRED_FROM_BUFFER = 2


class ExcitationSource(Enum):
    """Where a sensor's supply comes from."""

    INTERNAL = 10200
    EXTERNAL = 10167
    NONE = 10230


class FillMode(Enum):
    """Order of samples in an array."""

    GROUP_BY_CHANNEL = 0
    GROUP_BY_SCAN_NUMBER = 1


class ForceIEPESensorSensitivityUnits(Enum):
    """Units of a force sensor's sensitivity."""

    MILLIVOLTS_PER_NEWTON = 15891
    MILLIVOLTS_PER_POUND = 15892


class ForceUnits(Enum):
    """Units in which forces are read."""

    NEWTONS = 15875
    POUNDS = 15876
    KILOGRAM_FORCE = 15877
    FROM_CUSTOM_SCALE = 10065


class LoggingMode(Enum):
    """Whether a task logs what it acquires."""

    OFF = 10231
    LOG = 15844
    LOG_AND_READ = 15842


class LoggingOperation(Enum):
    """How a log file is opened."""

    OPEN = 10437
    OPEN_OR_CREATE = 15846
    CREATE_OR_REPLACE = 15847
    CREATE = 15848


class OverwriteMode(Enum):
    """What happens when the input buffer is full."""

    OVERWRITE_UNREAD_SAMPLES = 10252
    DO_NOT_OVERWRITE_UNREAD_SAMPLES = 10159


class ProductCategory(Enum):
    """Family of a device."""

    USBDAQ = 14646
    DSA = 14649
    COMPACT_DAQ_CHASSIS = 14658
    C_SERIES_MODULE = 14659
    SCXI_MODULE = 14660
    UNKNOWN = 12588


class ReadRelativeTo(Enum):
    """What a read's offset counts from."""

    FIRST_SAMPLE = 10424
    CURRENT_READ_POSITION = 10425
    REFERENCE_TRIGGER = 10426
    FIRST_PRETRIGGER_SAMPLE = 10427
    MOST_RECENT_SAMPLE = 10428


class RegenerationMode(Enum):
    """Whether an output task may play its buffer again."""

    ALLOW_REGENERATION = 10097
    DONT_ALLOW_REGENERATION = 10158


class ResolutionType(Enum):
    """Units of a resolution."""

    BITS = 10109


class SampleTimingType(Enum):
    """What paces a task."""

    SAMPLE_CLOCK = 10388
    ON_DEMAND = 10390


class Signal(Enum):
    """Hardware signals."""

    SAMPLE_CLOCK = 12487
    REFERENCE_TRIGGER = 12490
    START_TRIGGER = 12491
    SAMPLE_COMPLETE = 12530


class Slope(Enum):
    """Slope of an analog signal."""

    RISING = 10280
    FALLING = 10171


class SyncType(Enum):
    """Role of a device among synchronised ones."""

    NONE = 10230
    MASTER = 15888
    SLAVE = 15889


class TaskMode(Enum):
    """Steps of a task's life."""

    TASK_START = 0
    TASK_STOP = 1
    TASK_VERIFY = 2
    TASK_COMMIT = 3
    TASK_RESERVE = 4
    TASK_UNRESERVE = 5
    TASK_ABORT = 6


class TerminalConfiguration(Enum):
    """How an input is wired."""

    RSE = 10083
    NRSE = 10078
    DIFF = 10106
    PSEUDO_DIFF = 12529
    DEFAULT = -1


class TriggerType(Enum):
    """Kinds of triggers."""

    ANALOG_EDGE = 10099
    DIGITAL_EDGE = 10150
    NONE = 10230


class UsageTypeAI(Enum):
    """What an input channel measures."""

    VOLTAGE = 10322
    ACCELERATION_ACCELEROMETER_CURRENT_INPUT = 10356
    VELOCITY_IEPE_SENSOR = 15966
    FORCE_IEPE_SENSOR = 15895


class UsageTypeAO(Enum):
    """What an output channel makes."""

    VOLTAGE = 10322


class VelocityIEPESensorSensitivityUnits(Enum):
    """Units of a velocity sensor's sensitivity."""

    MILLIVOLTS_PER_MILLIMETER_PER_SECOND = 15963
    MILLIVOLTS_PER_INCH_PER_SECOND = 15964


class VelocityUnits(Enum):
    """Units in which velocities are read."""

    METERS_PER_SECOND = 15959
    INCHES_PER_SECOND = 15960
    FROM_CUSTOM_SCALE = 10065


class VoltageUnits(Enum):
    """Units in which voltages are read."""

    VOLTS = 10348
    FROM_CUSTOM_SCALE = 10065


class WaitMode(Enum):
    """How a read waits."""

    WAIT_FOR_INTERRUPT = 12523
    POLL = 12524
    YIELD = 12525
    SLEEP = 12547


class WaveformAttributeMode(Flag):
    """What a waveform read fills in besides samples."""

    TIMING = 1
    EXTENDED_PROPERTIES = 2


class WriteRelativeTo(Enum):
    """What a write's offset counts from."""

    FIRST_SAMPLE = 10424
    CURRENT_WRITE_POSITION = 10430
