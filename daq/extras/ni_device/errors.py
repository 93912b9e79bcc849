"""Errors of the emulated device, with the codes that NI publishes for its driver: clients check these codes."""

from collections.abc import Mapping

from nidaqmx.error_codes import DAQmxErrors, DAQmxWarnings

from rig.core.base.errors import ShotrigError

Code = DAQmxErrors
STOPPED_BEFORE_DONE = int(DAQmxWarnings.STOPPED_BEFORE_DONE)


# Error messages of NI's driver for the errors of the device. Scripts and users recognize errors by these messages.
DRIVER_TEXTS: Mapping[int, str] = {
    STOPPED_BEFORE_DONE: "Finite acquisition or generation has been stopped before the requested number of "
    "samples were acquired or generated.",
    Code.PAL_RESOURCE_RESERVED: "The specified resource is reserved. The operation could not be completed as "
    "specified.",
    Code.INVALID_ATTRIBUTE_VALUE: "Requested value is not a supported value for this property. The property value may "
    "be invalid because it conflicts with another property.",
    Code.SAMPLE_RATE_NUM_CHANS_CONVERT_PERIOD_COMBO: "Sample rate exceeds the maximum sample rate for the number of "
    "channels specified.",
    Code.MIN_NOT_LESS_THAN_MAX: "Minimum is greater than or equal to the maximum.",
    Code.INVALID_TASK: "Task specified is invalid or does not exist.",
    Code.DUPLICATE_TASK: "Task name conflicts with an existing task name.",
    Code.PHYSICAL_CHAN_DOES_NOT_EXIST: "Physical channel specified does not exist on this device.",
    Code.ATTR_NOT_SUPPORTED: "Attribute is not supported.",
    Code.INVALID_DEVICE_ID: "Device identifier is invalid.",
    Code.ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE: "Acquisition has been stopped to prevent an input buffer "
    "overwrite.",
    Code.READ_BUFFER_TOO_SMALL: "Buffer is too small to fit read data.",
    Code.SAMPLES_WILL_NEVER_BE_AVAILABLE: "Attempted to read a sample beyond the final sample acquired.",
    Code.SAMPLES_NO_LONGER_AVAILABLE: "The application is not able to keep up with the hardware acquisition.",
    Code.SAMPLES_NOT_YET_AVAILABLE: "Some or all of the samples requested have not yet been acquired.\n\nTo wait for "
    "the samples to become available use a longer read timeout or read later in your program. To make the samples "
    "available sooner, increase the sample rate. If your task uses a start trigger, make sure that your start trigger "
    "is configured correctly. It is also possible that you configured the task for external timing, and no clock was "
    "supplied. If this is the case, supply an external clock.",
    Code.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES: "The generation has stopped to prevent the regeneration of old "
    "samples. Your application was unable to write samples to the background buffer fast enough to prevent old samples "
    "from being regenerated.",
    Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN: "Some or all of the samples to write could not be written to the buffer yet. "
    "More space will free up as samples currently in the buffer are generated.",
    Code.INPUT_FIFO_OVERFLOW_2: "Onboard device memory overflow. Because of system and/or bus-bandwidth limitations, "
    "the driver could not read data from the device fast enough to keep up with the device throughput.",
    Code.PHYS_CHAN_MEAS_TYPE: "Selected physical channel does not support the measurement type required by the virtual "
    "channel you are creating.",
    Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT: "Specified property is not supported by the device or is not "
    "applicable to the task.",
    Code.OUTPUT_BUFFER_EMPTY: "Generation cannot be started because the output buffer is empty.",
    Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED: "Read cannot be performed when the Auto "
    "Start property is false and the task is not running or committed.",
    Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK: "Specified operation cannot be performed when there are no channels "
    "in the task.",
    Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING: "Specified operation cannot be performed while the task is running.",
    Code.REPEATED_PHYSICAL_CHAN: "Physical channel included in a task more than once.",
    Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING: "Syntax for a range of objects in the input string is invalid.",
    Code.WRITE_NUM_CHANS_MISMATCH: "Write cannot be performed because the number of channels in the data does not "
    "match the number of channels in the task.",
    Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING: "Specified property cannot be set while the task is running.",
    Code.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE: "Wait Until Done did not indicate that the task was done within the "
    "specified timeout.",
    Code.INVALID_AO_DATA_WRITE: "Attempted writing analog data that is too large or too small.",
    Code.CANNOT_REGISTER_DA_QMX_SOFTWARE_EVENT_WHILE_TASK_IS_RUNNING: "DAQmx software event cannot be registered "
    "because the task is running.",
    Code.SAMP_CLK_RATE_MUST_BE_SPECD: "Task contains physical channels on one or more devices that require you to "
    "specify the Sample Clock rate.",
}


def driver_text(code: int) -> str:
    """Return the message of NI's driver for a code; without a message the name of the code; empty for an unknown code.

    >>> driver_text(-200220), driver_text(-200709), driver_text(-12345)
    ('Device identifier is invalid.', 'Teds sensor not detected.', '')
    """
    if code in DRIVER_TEXTS:
        return DRIVER_TEXTS[code]
    return f"{Code(code).name.replace('_', ' ').capitalize()}." if code in list(Code) else ""


class DaqError(ShotrigError):
    """An error in a call of the emulated device.

    `message` is the cause and the remedy, `code` the driver's code, `samples_done` the number of samples per channel
    that were read or written before the error.

    >>> error = DaqError("no such device", Code.INVALID_DEVICE_ID)
    >>> int(error.code), str(error)
    (-200220, 'no such device')
    """

    def __init__(self, message: str, code: int, samples_done: int | None = None) -> None:
        super().__init__(message)
        self.code = int(code)
        self.samples_done = samples_done


def invalid_value(message: str) -> DaqError:
    """Return the error for an invalid value (-200077)."""
    return DaqError(message, Code.INVALID_ATTRIBUTE_VALUE)


def unsupported(feature: str, remedy: str = "Test this part with hardware.") -> DaqError:
    """Return the error for a function that the emulated device does not support (-200452)."""
    return DaqError(
        f"{feature} is not supported by the emulated device. {remedy}", Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT
    )
