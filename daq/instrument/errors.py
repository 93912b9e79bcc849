"""Errors of the instrument, with the codes that NI publishes for its driver: clients look for them."""

from __future__ import annotations

from nidaqmx.error_codes import DAQmxErrors

from rig.errors import ShotrigError

Code = DAQmxErrors
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
