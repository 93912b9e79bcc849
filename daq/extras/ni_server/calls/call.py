"""A remote call, and helpers for its handlers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from daq.extras.ni_device.task import Task
from daq.extras.ni_server.served_instrument import ServedInstrument

# Values of a response by field name.
ResponseFields = dict[str, Any]
# Function that executes a call and returns the response; None is an empty response.
Handler = Callable[["Call"], ResponseFields | None]


@dataclass
class Call:
    """A remote procedure call of a client."""

    instrument: ServedInstrument
    peer: str  # address of the client
    message: Any = None  # request, as a protobuf message
    fields: dict[str, Any] = field(default_factory=dict)  # fields of the request, see `decode` in `protocol`
    strict: bool = False  # for a duplicate task name, report the error of NI's driver instead of the error of a session
    is_active: Callable[[], bool] = lambda: True  # returns whether the client still waits for the response

    @property
    def task(self) -> Task:
        """Task of the call. Raises `DaqError` -200088 if there is no task of that name."""
        return self.instrument.sessions.find(self.fields["task"], self.peer)


def plain_value(value: Any) -> Any:
    """Convert a numpy array to a list; return any other value unchanged."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def task_action(action: Callable[[Task, dict[str, Any]], Any]) -> Handler:
    """Return the handler that calls `action` with the task and the fields of the call.

    If the action returns an integer, it is the status of the response: the code of a warning, or 0.
    """

    def handle(call: Call) -> ResponseFields:
        status = action(call.task, call.fields)
        return {"status": status} if isinstance(status, int) else {}

    return handle
