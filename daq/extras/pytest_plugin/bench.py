"""A bench for tests: the emulated devices, the samples that a program has read and written, and faults."""

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

import rig
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import Clock
from daq.extras.ni_device.clock import clock as make_clock
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_device.errors import DaqError
from daq.extras.ni_device.settings.task_settings import TaskSettings
from daq.extras.ni_device.task import Task
from daq.extras.ni_server.connection import Connection
from daq.extras.ni_server.served_instrument import Limits
from daq.extras.pytest_plugin.callback_waits import CallbackWaits, pause
from daq.extras.pytest_plugin.description import BenchError, find_channel, wired_bench
from daq.extras.pytest_plugin.faults import Faults
from daq.extras.pytest_plugin.transfers import Transfers
from daq.extras.pytest_plugin.wired_terminals import WiredTerminals
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene
from rig.core.scene.scene_files import bundled_scenes, read_text
from rig.core.scene.yaml_reader import Document, read_yaml

#: Modules of a bench without a description.
DEFAULT_MODULES = ("NI 9234", "NI 9263")
# Wall-clock time of a sleep while the bench is in use [s]. In this time, other threads of the program can finish a
# call.
_YIELD_S = 0.002
BenchLike = Scene | str | Path | Mapping[str, Any] | Sequence[str]


class NidaqmxBench:
    """A bench of emulated devices for tests, in this process; the fixture `nidaqmx_bench` opens one.

    Attributes
    ----------
    grpc_options : nidaqmx.GrpcSessionOptions
        Session options of tasks on this bench. With the fixture, tasks without options use this bench too.
    address : str
        Address of the bench for other processes and languages, host and port.
    transfers : Transfers
        All reads and writes of tasks.
    faults : Faults
        Methods that inject faults.
    callback_waits : CallbackWaits
        Waits for callbacks; the fixture replaces Python's waiting functions by its own.
    """

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis
        self._devices = chassis.devices.all()
        self.transfers, self.faults = Transfers(), Faults(chassis)
        chassis.transfer_listeners.append(self.transfers.add)
        self.grpc_options = Connection(chassis, Limits())
        self.address = self.grpc_options.address
        self.callback_waits = CallbackWaits(chassis)

    @property
    def follows_wall_clock(self) -> bool:
        """Whether time on the bench is real time."""
        return self._chassis.clock.is_free_running

    @property
    def elapsed(self) -> float:
        """Time that has passed on the bench [s]; it passes while a task that has been started is open."""
        return self._chassis.elapsed

    @property
    def open_tasks(self) -> list[str]:
        """Names of the tasks that have not been closed."""
        return [name for name in self._chassis.tasks if name not in self.faults.other_clients]

    def sleep(self, seconds: float) -> None:
        """Let time pass on the bench while it is in use, otherwise on the wall clock; replaces `time.sleep`."""
        is_in_use = self._chassis.is_in_use
        pause(min(seconds, _YIELD_S) if is_in_use else seconds)
        if is_in_use:
            self.callback_waits.sleep(seconds)

    def read(self, channel: str) -> Array:
        """Return all samples that tasks have read from an input, such as "ai0" or "cDAQ1Mod1/ai0"."""
        return self.transfers.samples("read", find_channel(self._devices, channel, "ai", "read")[0])

    def written(self, channel: str) -> Array:
        """Return all samples that tasks have written to an output [V]."""
        return self.transfers.samples("written", find_channel(self._devices, channel, "ao", "written")[0])

    def assert_written(self, channel: str, expected: ArrayLike, tolerance: float = 1e-3) -> None:
        """Fail unless the samples written to an output are the expected samples within a tolerance [V]."""
        written, required = self.written(channel), np.atleast_1d(np.asarray(expected, dtype=float))
        if written.shape != required.shape:
            raise AssertionError(f"{channel}: {written.size} samples were written; expected {required.size}.")
        deviation = np.abs(written - required)
        # The negated comparison also detects NaN.
        different = np.flatnonzero(~(deviation <= tolerance))
        if different.size:
            first = different[0]
            raise AssertionError(
                f"{channel}: {different.size} of {written.size} samples differ by more than {tolerance:g} V, by up to "
                f"{deviation.max():g} V. Sample {first} is {written[first]:g} V; expected {required[first]:g} V."
            )

    def save_task(self, name: str, configure: Callable[[TaskSettings], None]) -> None:
        """Save a task under a name, as in NI MAX; `configure` sets its channels and timing."""
        storage = self.grpc_options.storage
        task = Task(self._chassis, "", storage.scales)
        try:
            configure(task.settings)
            storage.save_task(task.settings, name, "")
        finally:
            task.close()

    def reset(self, keep: Collection[str] = ()) -> None:
        """Close all tasks, except those named in `keep`, and end all faults; warn of faults that have not occurred."""
        unused_faults = self.faults.reset()
        self.grpc_options.close_tasks(keep)
        # If warnings are errors, the first ends this method.
        for unused in unused_faults:
            warnings.warn(f"{unused} has had no effect: the program made too few calls.", stacklevel=2)

    def close(self) -> None:
        """Close the bench and all its tasks."""
        try:
            self.reset()
        finally:
            self.grpc_options.close(grace=None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_bench(
    bench: BenchLike = DEFAULT_MODULES,
    *,
    wires: Sequence[str] = (),
    sources: Mapping[str, Any] | None = None,
    pulses: Mapping[str, Any] | None = None,
    clock: str | Clock = "fast",
) -> NidaqmxBench:
    """Open a bench for tests.

    Parameters
    ----------
    bench : Scene, str, Path, mapping or sequence of str
        A scene (see `rig.load`); or product types of modules, as a list or separated by commas; or a description with
        the keys `modules`, `chassis`, `wires`, `sources`, `pulses` and `tasks`, as a mapping or a YAML file.
    wires : sequence of str, optional
        Connections of outputs to inputs, such as "ao0 -> ai0"; only for modules.
    sources : mapping, optional
        Voltage at inputs without a wire: {"ai1": "0.5 V"}, or {"ai1": {"amplitude": "1 V", "frequency": "50 Hz"}}, or a
        function that returns the voltages [V] at an array of times [s]; only for modules.
    pulses : mapping, optional
        Frequencies of pulses at trigger terminals, such as {"PFI0": "1 Hz"}; only for modules.
    clock : {'fast', 'real'} or Clock, optional
        With 'fast', time passes only during calls of tasks, in `time.sleep`, and while the main thread waits for a
        callback in `threading.Event.wait` or `queue.Queue.get`, as fast as the machine computes.

    Raises
    ------
    BenchError, SceneError
        If there is no such module or scene, or the description has problems.
    """
    given = {"wires": wires, "sources": sources, "pulses": pulses}
    connections: dict[str, Any] = {key: value for key, value in given.items() if value}
    document, where = _read_description(bench)
    if document is None:
        if connections:
            raise BenchError(f"{', '.join(connections)} cannot be combined with a scene. Give modules instead of it.")
        scene = rig.load(bench)  # type: ignore[arg-type]  # reports other types
        return NidaqmxBench(connect_scene(scene, clock))
    wired = wired_bench({**document.content, **connections}, where, document.line if document.lines else None)
    terminals: Any = WiredTerminals(wired)
    opened = NidaqmxBench(Chassis(wired.modules, terminals, make_clock(clock)))
    try:
        for name, saved in wired.tasks.items():
            opened.save_task(name, saved.configure)
    except DaqError as error:
        opened.close()
        raise BenchError(f"{where}: tasks.{name}: {error}") from None
    return opened


def _read_description(bench: BenchLike) -> tuple[Document | None, str]:
    """Return the description of a bench, and its name in messages; None instead of a description for a scene."""
    where = "bench"
    if isinstance(bench, str | Path) and bench not in bundled_scenes():
        path = Path(bench)
        if path.is_file():
            document, where = read_yaml(read_text(path)), str(bench)
            is_scene = not isinstance(document.content, dict) or "structure" in document.content
            return (None if is_scene else document), where
        if path.suffix not in (".yaml", ".yml"):
            return Document({"modules": [name.strip() for name in str(bench).split(",")]}), where
    elif isinstance(bench, Mapping) and "structure" not in bench:
        return Document(dict(bench)), where
    elif isinstance(bench, list | tuple):
        return Document({"modules": list(bench)}), where
    return None, where
