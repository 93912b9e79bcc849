"""Errors of the instrument, with the codes that clients of NI-DAQmx look for."""

from __future__ import annotations

from enum import IntEnum

from rig.errors import ShotrigError


class Code(IntEnum):
    """Codes of the errors this instrument raises; names and numbers as the NI-DAQmx driver has them."""

    UNKNOWN = -1
    TIMESTAMP_NOT_ENABLED = -209842
    INVALID_GLOBAL_CHAN = -200882
    AI_MAX_NOT_SPECIFIED = -200695
    AI_MIN_NOT_SPECIFIED = -200694
    PROPERTY_NOT_SUPPORTED_FOR_SCALE_TYPE = -200601
    INVALID_ROUTING_DESTINATION_TERMINAL_NAME_ROUTING = -89121
    INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING = -89120
    ROUTE_NOT_SUPPORTED_BY_HW_ROUTING = -89136
    PAL_RESOURCE_RESERVED = -50103
    LOGGING_NOT_SUPPORT_ON_OUTPUT_TASKS = -201332
    READ_NOT_SUPPORTED_FOR_LOGGING_MODE = -201301
    LOGGING_MODE_NOT_SUPPORTED_NON_BUFFERED = -201299
    M_STUDIO_OPERATION_DOES_NOT_SUPPORT_DEVICE_CONTEXT = -201118
    SAMP_CLK_RATE_MUST_BE_SPECD = -201087
    CANNOT_GET_PROPERTY_WHEN_TASK_NOT_RESERVED_COMMITTED_OR_RUNNING = -200983
    EVERY_N_SAMPLES_ACQ_INTO_BUFFER_EVENT_NOT_SUPPORTED_BY_DEVICE = -200981
    EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_NOT_SUPPORTED_BY_DEVICE = -200980
    EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_ALREADY_REGISTERED = -200967
    EVERY_N_SAMPS_ACQ_INTO_BUFFER_EVENT_ALREADY_REGISTERED = -200966
    CANNOT_REGISTER_DA_QMX_SOFTWARE_EVENT_WHILE_TASK_IS_RUNNING = -200960
    DONE_EVENT_ALREADY_REGISTERED = -200950
    SIGNAL_EVENT_ALREADY_REGISTERED = -200949
    EVERY_N_SAMPS_EVENT_INTERVAL_ZERO_NOT_SUPPORTED = -200880
    EVERY_N_SAMPLES_EVENT_NOT_SUPPORTED_FOR_NON_BUFFERED_TASKS = -200848
    TEDS_SENSOR_DATA_ERROR = -200826
    CANT_CONFIGURE_TEDS_FOR_CHAN = -200791
    VIRTUAL_TEDS_FILE_NOT_FOUND = -200784
    TEDS_SENSOR_NOT_DETECTED = -200709
    OUTPUT_FIFO_UNDERFLOW_2 = -200621
    INVALID_AO_DATA_WRITE = -200561
    WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE = -200560
    CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING = -200557
    WRITE_NUM_CHANS_MISMATCH = -200524
    INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING = -200498
    CHAN_ALREADY_IN_TASK = -200489
    VIRTUAL_CHAN_DOES_NOT_EXIST = -200488
    TASK_NOT_IN_DATA_NEIGHBORHOOD = -200485
    CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING = -200479
    CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK = -200478
    CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED = -200473
    OUTPUT_BUFFER_EMPTY = -200462
    READ_NO_INPUT_CHANS_IN_TASK = -200460
    WRITE_NO_OUTPUT_CHANS_IN_TASK = -200459
    ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT = -200452
    PHYS_CHAN_MEAS_TYPE = -200431
    CUSTOM_SCALE_DOES_NOT_EXIST = -200378
    OVERLOADED_CHANS_EXIST_NOT_READ = -200362
    INPUT_FIFO_OVERFLOW_2 = -200361
    REF_TRIG_WHEN_CONTINUOUS = -200358
    SAMPLES_CAN_NOT_YET_BE_WRITTEN = -200292
    GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES = -200290
    SAMPLES_NOT_YET_AVAILABLE = -200284
    NO_REF_TRIG_CONFIGURED = -200282
    SAMPLES_NO_LONGER_AVAILABLE = -200279
    SAMPLES_WILL_NEVER_BE_AVAILABLE = -200278
    NEGATIVE_READ_SAMPLE_NUMBER = -200277
    INVALID_ANALOG_TRIG_SRC = -200265
    TRIG_WHEN_ON_DEMAND_SAMP_TIMING = -200262
    READ_BUFFER_TOO_SMALL = -200229
    ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE = -200222
    INVALID_DEVICE_ID = -200220
    TOO_MANY_PRETRIG_PLUS_MIN_POST_TRIG_SAMPS = -200213
    ATTR_NOT_SUPPORTED = -200197
    VIRTUAL_CHAN_NAME_USED = -200171
    PHYSICAL_CHAN_DOES_NOT_EXIST = -200170
    DUPLICATE_TASK = -200089
    INVALID_TASK = -200088
    MIN_NOT_LESS_THAN_MAX = -200082
    INVALID_ATTRIBUTE_VALUE = -200077
    MISMATCHED_INPUT_ARRAY_SIZES = -200672
    NO_MORE_SPACE = -200293


STOPPED_BEFORE_DONE = 200010


def meaning(code: int) -> str:
    """Say what a code means; empty if it is none of these.

    Examples
    --------
    >>> meaning(-200077)
    'Requested value is not a supported value for this property.'
    """
    if code == STOPPED_BEFORE_DONE:
        return "A finite acquisition or generation was stopped before it was complete."
    if code == Code.INVALID_ATTRIBUTE_VALUE:
        return "Requested value is not a supported value for this property."
    return f"{Code(code).name.replace('_', ' ').capitalize()}." if code in list(Code) else ""


class DaqError(ShotrigError):
    """A call the instrument could not carry out.

    Parameters
    ----------
    message : str
        What was wrong and what to do.
    code : int
        The driver's code for it.
    done : int, optional
        Samples per channel that were read or written all the same.

    Examples
    --------
    >>> error = DaqError("no such device", Code.INVALID_DEVICE_ID)
    >>> int(error.code), str(error)
    (-200220, 'no such device')
    """

    def __init__(self, message: str, code: int, done: int | None = None) -> None:
        super().__init__(message)
        self.code = int(code)
        self.done = done


def bad(message: str) -> DaqError:
    """Make the error for a value that cannot be (-200077)."""
    return DaqError(message, Code.INVALID_ATTRIBUTE_VALUE)


def unsupported(what: str, instead: str = "") -> DaqError:
    """Make the error for something this instrument does not have (-200452)."""
    hint = f" {instead}" if instead else ""
    return DaqError(
        f"{what} is not supported by the rig's instrument.{hint}",
        Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT,
    )
