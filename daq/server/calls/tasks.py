"""Calls about a task as a whole: sessions, states, events."""

from __future__ import annotations

from collections.abc import Callable

from daq.instrument.errors import Code, DaqError, bad
from daq.instrument.task import Task
from daq.server.calls.call import Answer, Call, does


def _create_task(call: Call) -> Answer:
    return _session(call, call.fields["session_name"])


def _load_task(call: Call) -> Answer:
    name = call.fields["session_name"]
    if name not in call.instrument.storage.tasks:
        raise DaqError(f"there is no saved task {name!r}", Code.TASK_NOT_IN_DATA_NEIGHBORHOOD)
    answer = _session(call, name)
    if answer["new_session_initialized"]:
        task = call.instrument.sessions.find(answer["task"], call.peer)
        call.instrument.storage.load_task(task.settings, name)
    return answer


def _session(call: Call, name: str) -> Answer:
    behavior = call.fields.get("initialization_behavior", 0)
    if call.strict and name:
        call.instrument.sessions.check_free(name)
    session, new = call.instrument.sessions.open(name, behavior, call.peer)
    return {"task": session, "new_session_initialized": new}


def _clear_task(call: Call) -> Answer:
    call.instrument.sessions.close(call.fields["task"], call.peer)
    return {}


def _nth(values: Callable[[Task], list[str]]) -> Callable[[Call], Answer]:
    def ask(call: Call) -> Answer:
        found, index = values(call.task), call.fields["index"]
        if not 1 <= index <= len(found):
            raise bad(f"number {index}: expected 1 to {len(found)}")
        return {"buffer": found[index - 1]}

    return ask


def _error_string(call: Call) -> Answer:
    return {"error_string": call.instrument.text_of_error(call.peer, call.fields["error_code"])}


CALLS: dict[str, Callable[[Call], Answer]] = {
    "CreateTask": _create_task,
    "LoadTask": _load_task,
    "ClearTask": _clear_task,
    "StartTask": does(lambda task, given: task.start()),
    "StopTask": does(lambda task, given: task.stop()),
    "TaskControl": does(lambda task, given: task.control(given["action"])),
    "IsTaskDone": lambda call: {"is_task_done": call.task.is_done()},
    "WaitUntilTaskDone": does(lambda task, given: task.wait_until_done(given["time_to_wait"])),
    "GetNthTaskChannel": _nth(lambda task: [each.name for each in task.settings.channels]),
    "GetNthTaskDevice": _nth(lambda task: task.settings.device_names),
    "GetNthTaskReadChannel": _nth(
        lambda task: [task.settings.channels[row].name for row in task.settings.rows_to_read()]
    ),
    "GetErrorString": _error_string,
    "UnregisterEveryNSamplesEvent": does(
        lambda task, given: task.events.listen_every(given["every_n_samples_event_type"], 0, None)
    ),
    "UnregisterDoneEvent": does(lambda task, given: task.events.listen_done(None)),
    "UnregisterSignalEvent": does(lambda task, given: task.events.listen_signal(given["signal_id"], None)),
}
