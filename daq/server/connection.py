"""Connecting to a rig in this process: `daq.connect`."""

from __future__ import annotations

import atexit
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from nidaqmx import GrpcSessionOptions

from daq.instrument.clock import Clock
from daq.instrument.connecting import connect_scene
from daq.server.bench_time import BenchTime
from daq.server.grpc_channel import open_channel
from daq.server.served_instrument import Limits
from daq.server.service import Server
from daq.signal_chain.channel import ChannelInfo
from rig.scene.scene import Scene


class Connection(GrpcSessionOptions):
    """A rig in this process, for NI's client: ``nidaqmx.Task(grpc_options=connection)``.

    It is the client's own session options, with the rig behind it. Close it, or use it in a `with` block.

    Attributes
    ----------
    chassis : Chassis
        The instrument.
    address : str
        Where it can be reached from other processes.
    """

    def __init__(self, scene: Scene | str | Path | None, clock: str | Clock | None, limits: Limits) -> None:
        self.chassis = connect_scene(scene, clock)
        self._server = Server(self.chassis, limits=limits, further=(BenchTime(self.chassis),))
        self.address = f"127.0.0.1:{self._server.port}"
        self._open = True
        super().__init__(open_channel(self.address), "")
        _left_open.add(self)

    @property
    def options(self) -> GrpcSessionOptions:
        """Session options of the client: this object."""
        return self

    @property
    def sensors(self) -> tuple[ChannelInfo, ...]:
        """What is wired to ai0, ai1, ...; each with its position, quantity and sensitivity."""
        return tuple(self.chassis.bench.channels)

    def pass_time(self, seconds: float) -> None:
        """Let some bench time pass."""
        self.chassis.pass_time(seconds)

    def close(self, grace: float | None = 0.5) -> None:
        """End the rig and all its tasks; calls that are still being answered have so many seconds to end, or none."""
        if self._open:
            self._open = False
            _left_open.discard(self)
            self.grpc_channel.close()
            self._server.close(grace)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


# Rigs that nobody has closed.
_left_open: set[Connection] = set()


def _close_left_open() -> None:
    # A server that gives its calls time starts a thread, which Python refuses when it ends.
    for each in list(_left_open):
        each.close(grace=None)


# Python waits for the threads that answer calls before it comes to `atexit`: they have to end earlier.
getattr(threading, "_register_atexit", atexit.register)(_close_left_open)


def connect(
    scene: Scene | str | Path | None = None,
    clock: str | Clock | None = None,
    limits: Limits | None = None,
) -> Connection:
    """Put an instrument in front of a scene's bench, for NI's client `nidaqmx`.

    Parameters
    ----------
    scene : Scene or str or Path, optional
        Scene, name of a bundled one, or path of a scene file. Else the one named by the environment variable
        SHOTRIG_SCENE, else the paper's rig with three dampers and inputs of ±10 V.
    clock : {'real', 'fast', 'manual'} or Clock, optional
        What lets time pass, see `daq.instrument.clock`. Else what the environment variable SHOTRIG_CLOCK says,
        else 'real': a live bench.
    limits : Limits, optional
        What clients may ask for.

    Returns
    -------
    Connection

    Raises
    ------
    SceneError
        If the scene cannot be used or there is no such clock.

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
    return Connection(scene, clock, limits or Limits())
