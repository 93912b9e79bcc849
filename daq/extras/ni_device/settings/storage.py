"""Tasks, channels and scales saved under a name; they are stored while the instrument runs."""

from copy import deepcopy
from dataclasses import dataclass, field
from typing import TypeVar

from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.settings.properties import Properties
from daq.extras.ni_device.settings.scales import Scale
from daq.extras.ni_device.settings.task_settings import TaskSettings

# Maximum number of saved tasks, channels or scales, so a client cannot exhaust the memory.
MAX_SAVED = 1000
Value = TypeVar("Value")


@dataclass
class Storage:
    """Saved tasks, channels and scales, by name."""

    # Channels of each task, and its settings by group, such as timing or triggers.
    tasks: dict[str, tuple[list[Channel], dict[str, Properties]]] = field(default_factory=dict)
    channels: dict[str, Channel] = field(default_factory=dict)
    scales: dict[str, Scale] = field(default_factory=dict)
    authors: dict[str, str] = field(default_factory=dict)  # author of each saved item, by name

    def store(self, saved: dict[str, Value], name: str, value: Value) -> None:
        """Store a value under a name; raise `DaqError` -200077 if the maximum number of values is already stored."""
        if name not in saved and len(saved) >= MAX_SAVED:
            raise invalid_value(
                f"{name!r} cannot be saved: the maximum is {MAX_SAVED} tasks, {MAX_SAVED} channels and {MAX_SAVED} "
                "scales. Delete a saved item of the same kind first."
            )
        saved[name] = value

    def scale(self, name: str) -> Scale:
        """Return a scale by name. Raises `DaqError` -200378 if it does not exist."""
        if name not in self.scales:
            raise DaqError(f"there is no scale {name!r}. Create the scale first.", Code.CUSTOM_SCALE_DOES_NOT_EXIST)
        return self.scales[name]

    def save_task(self, task: TaskSettings, name: str, author: str) -> None:
        """Save a task's settings."""
        self.store(self.tasks, name, deepcopy((task.channels, task.groups)))
        self.authors[name] = author

    def load_task(self, task: TaskSettings, name: str) -> None:
        """Load saved settings into a task."""
        task.channels, task.groups = deepcopy(self.tasks[name])

    def save_channel(self, channel: Channel, name: str, author: str) -> None:
        """Save a channel for other tasks."""
        saved = deepcopy(channel)
        saved.name, saved.settings["chan_is_global"] = name, True
        self.store(self.channels, name, saved)
        self.authors[name] = author

    def channel(self, name: str) -> Channel:
        """Return a saved channel by name. Raises `DaqError` -200882 if it does not exist."""
        if name not in self.channels:
            raise DaqError(f"there is no saved channel {name!r}. Save the channel first.", Code.INVALID_GLOBAL_CHAN)
        return deepcopy(self.channels[name])
