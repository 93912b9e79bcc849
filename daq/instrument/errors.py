"""Errors and warnings of the instrument, with the codes that scripts written for NI-DAQmx look for."""

from __future__ import annotations

from enum import IntEnum

from rig.errors import ShotrigError


class DAQmxErrors(IntEnum):
    """Codes of the errors this instrument raises; names and numbers as the NI-DAQmx driver has them."""

    UNKNOWN = -1
    PAL_RESOURCE_RESERVED = -50103
    LOGGING_NOT_SUPPORT_ON_OUTPUT_TASKS = -201332
    READ_NOT_SUPPORTED_FOR_LOGGING_MODE = -201301
    DONE_EVENT_ALREADY_REGISTERED = -200950
    EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_ALREADY_REGISTERED = -200967
    EVERY_N_SAMPS_ACQ_INTO_BUFFER_EVENT_ALREADY_REGISTERED = -200966
    EVERY_N_SAMPS_EVENT_INTERVAL_ZERO_NOT_SUPPORTED = -200880
    EVERY_N_SAMPLES_EVENT_NOT_SUPPORTED_FOR_NON_BUFFERED_TASKS = -200848
    OUTPUT_FIFO_UNDERFLOW_2 = -200621
    INVALID_AO_DATA_WRITE = -200561
    ANALOG_MULTI_SAMP_WRITE_NOT_SUPPORTED = -200539
    WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE = -200560
    WRITE_NUM_CHANS_MISMATCH = -200524
    INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING = -200498
    CHAN_ALREADY_IN_TASK = -200489
    CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING = -200479
    CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK = -200478
    CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED = -200473
    OUTPUT_BUFFER_EMPTY = -200462
    READ_NO_INPUT_CHANS_IN_TASK = -200460
    WRITE_NO_OUTPUT_CHANS_IN_TASK = -200459
    ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT = -200452
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
    PHYSICAL_CHAN_DOES_NOT_EXIST = -200170
    DUPLICATE_TASK = -200089
    INVALID_TASK = -200088
    INVALID_ATTRIBUTE_VALUE = -200077
    ROUTE_NOT_SUPPORTED_BY_HW_ROUTING = -89136


class DAQmxWarnings(IntEnum):
    """Codes of the warnings this instrument gives."""

    UNKNOWN = -1
    STOPPED_BEFORE_DONE = 200010


class DaqError(ShotrigError):
    """A call the instrument could not carry out.

    Parameters
    ----------
    message : str
        What was wrong and what to do.
    error_code : int
        The driver's code for it.
    task_name : str, optional
        The task it happened in.

    Examples
    --------
    >>> error = DaqError("no such device", DAQmxErrors.INVALID_DEVICE_ID)
    >>> error.error_code, error.error_type.name
    (-200220, 'INVALID_DEVICE_ID')
    """

    def __init__(self, message: str, error_code: int, task_name: str = "") -> None:
        self.bare_message = message
        self.task_name = task_name
        self._code = int(error_code)
        lines = [message, f"Task Name: {task_name}" if task_name else "", f"Status Code: {self._code}"]
        super().__init__("\n\n".join(line for line in lines if line))

    @property
    def error_code(self) -> int:
        """The driver's code."""
        return self._code

    @property
    def error_type(self) -> DAQmxErrors:
        """The driver's name for the code; UNKNOWN if this instrument does not use it."""
        return next((each for each in DAQmxErrors if each == self._code), DAQmxErrors.UNKNOWN)


class DaqReadError(DaqError):
    """A read that ended early; `samps_per_chan_read` samples were delivered and will not come again."""

    def __init__(self, message: str, error_code: int, samps_per_chan_read: int, task_name: str = "") -> None:
        super().__init__(message, error_code, task_name)
        self._read = int(samps_per_chan_read)

    @property
    def samps_per_chan_read(self) -> int:
        """Samples per channel delivered before the error."""
        return self._read


class DaqWriteError(DaqError):
    """A write that ended early; `samps_per_chan_written` samples were taken."""

    def __init__(
        self, message: str, error_code: int, samps_per_chan_written: int, task_name: str = ""
    ) -> None:
        super().__init__(message, error_code, task_name)
        self._written = int(samps_per_chan_written)

    @property
    def samps_per_chan_written(self) -> int:
        """Samples per channel taken before the error."""
        return self._written


class DaqWarning(Warning):
    """Something a script may want to hear about, with the driver's code."""

    def __init__(self, message: str, error_code: int) -> None:
        super().__init__(f"\nWarning {int(error_code)} occurred.\n\n{message}")
        self.bare_message = message
        self._code = int(error_code)

    @property
    def error_code(self) -> int:
        """The driver's code."""
        return self._code

    @property
    def error_type(self) -> DAQmxWarnings:
        """The driver's name for the code."""
        return next((each for each in DAQmxWarnings if each == self._code), DAQmxWarnings.UNKNOWN)


class DaqResourceWarning(ResourceWarning):
    """A task was left open, or closed twice."""


def unsupported(call: str, instead: str = "") -> DaqError:
    """Make the error for a call that this instrument does not have."""
    hint = f" {instead}" if instead else ""
    return DaqError(
        f"{call} is not supported by the rig's instrument.{hint}",
        DAQmxErrors.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT,
    )
