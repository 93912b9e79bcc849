"""Connection to a rig in this process: `daq.connect`."""

import atexit
import os
import threading
from collections.abc import Collection
from pathlib import Path
from typing import Self

from nidaqmx import GrpcSessionOptions

from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import Clock
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_server.bench_time import BenchTime
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.served_instrument import Limits
from daq.extras.ni_server.service import Server
from rig.core.scene.scene import Scene


class Connection(GrpcSessionOptions):
    """A rig in this process, as session options of NI's client: ``nidaqmx.Task(grpc_options=connection)``.

    Close the connection, or use it in a `with` block. `chassis` is the instrument, `storage` contains its saved tasks,
    and `address` is the address of the server for other processes.
    """

    def __init__(self, chassis: Chassis, limits: Limits) -> None:
        self.chassis = chassis
        self._server = Server(self.chassis, limits=limits, other_handlers=(BenchTime(self.chassis),))
        self.storage = self._server.instrument.storage
        self.address = f"127.0.0.1:{self._server.port}"
        self._open, self._process = True, os.getpid()
        super().__init__(open_channel(self.address), "")
        _open_connections.add(self)

    @property
    def options(self) -> GrpcSessionOptions:
        """Session options of the client: the connection itself."""
        return self

    @property
    def sensors(self) -> tuple[ChannelInfo, ...]:
        """Descriptions of the channels at ai0, ai1, ...: location, quantity, sensitivity and more."""
        return tuple(self.chassis.bench.channels)

    def pass_time(self, seconds: float) -> None:
        """Wait until a duration, s, has passed on the bench."""
        self.chassis.pass_time(seconds)

    def close_tasks(self, keep: Collection[str] = ()) -> None:
        """Close all tasks of clients, except those named in `keep`."""
        self._server.instrument.sessions.close_all(keep)

    def close(self, grace: float | None = 0.5) -> None:
        """Close the rig and all its tasks; running calls may finish within `grace` s (None: they are aborted)."""
        # A forked process has no threads of the rig.
        if self._open and os.getpid() == self._process:
            self._open = False
            _open_connections.discard(self)
            self.grpc_channel.close()
            self._server.close(grace)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_open_connections: set[Connection] = set()


def _close_open_connections() -> None:
    # A grace period would start a thread, which Python does not allow during its shutdown.
    for connection in list(_open_connections):
        connection.close(grace=None)


# Python waits for the threads that answer calls before it runs `atexit` functions, so the threads must end earlier.
getattr(threading, "_register_atexit", atexit.register)(_close_open_connections)


def connect(
    scene: Scene | str | Path | None = None, clock: str | Clock | None = None, limits: Limits | None = None
) -> Connection:
    """Connect an instrument to the bench of a scene, for NI's client `nidaqmx`.

    Parameters
    ----------
    scene : Scene or str or Path, optional
        Scene, name of a bundled scene, or path of a scene file. The default is the environment variable
        SHOTRIG_SCENE, then the paper's rig with three dampers and inputs of ±10 V.
    clock : {'real', 'fast', 'manual'} or Clock, optional
        Clock that advances the bench, see `daq.extras.ni_device.clock`. The default is the environment variable
        SHOTRIG_CLOCK, then 'real'.
    limits : Limits, optional
        Limits of the resources of clients.

    Returns
    -------
    Connection
        Give the connection to tasks as `grpc_options`; close it at the end, or use it in a `with` block.

    Raises
    ------
    SceneError
        If the scene cannot be used or there is no clock of that name.

    Examples
    --------
    >>> import nidaqmx
    >>> with connect("bare-structure", clock="fast") as rig:
    ...     with nidaqmx.Task(grpc_options=rig) as task:
    ...         _ = task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3", min_val=-500.0, max_val=500.0)
    ...         task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=100)
    ...         [len(samples) for samples in task.read(100)]
    [100, 100, 100, 100]
    """
    return Connection(connect_scene(scene, clock), limits or Limits())
