"""Serving a rig to other processes and machines: `daq serve`."""

from __future__ import annotations

import contextlib
import gc
import ipaddress
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from daq.instrument.chassis import Chassis
from daq.instrument.connecting import connect_scene
from daq.server.bench_time import BenchTime
from daq.server.live import LiveRecording, LiveView
from daq.server.service import Limits, Server
from daq.server.starter_script import starter_script
from daq.server.unfed_sensors import tell_unfed_sensors
from rig.ending_signals import ENDINGS
from rig.errors import SceneError
from rig.input_files import read_whole
from rig.scene.scene import Scene


@dataclass(frozen=True)
class Certificates:
    """Files that say who the server is, and whom it lets in.

    Parameters
    ----------
    certificate, key : Path
        The server's certificate chain and its private key, PEM.
    clients : Path or None
        Certificate of who signs the clients' certificates; with it, clients must have one.
    """

    certificate: Path
    key: Path
    clients: Path | None = None

    def credentials(self) -> grpc.ServerCredentials:
        """Read the files.

        Raises
        ------
        SceneError
            If one cannot be read.
        """
        pair = (_read(self.key), _read(self.certificate))
        root = None if self.clients is None else _read(self.clients)
        return grpc.ssl_server_credentials([pair], root, require_client_auth=root is not None)


def _read(path: Path) -> bytes:
    try:
        return read_whole(path)
    except OSError as error:
        raise SceneError(f"cannot read {path}: {error.strerror}; expected a PEM file") from None


def serve(
    scene: Scene | str | None,
    clock: str | None,
    host: str,
    port: int,
    certificates: Certificates | None = None,
    limits: Limits | None = None,
    record: Path | None = None,
    overwrite: bool = False,
    viewer: bool = False,
) -> None:
    """Serve a rig until Ctrl-C, SIGTERM or the end of its terminal.

    Parameters
    ----------
    scene, clock
        As `daq.connect` takes them.
    host, port : str and int
        Where to listen.
    certificates : Certificates, optional
        Needed for any address that other machines can reach.
    limits : Limits, optional
        What clients may ask for.
    record : Path, optional
        Recording of all that the bench does meanwhile.
    overwrite : bool
        Whether it may replace a file.
    viewer : bool
        Whether to show it in the rerun viewer.

    Raises
    ------
    SceneError
        If the scene cannot be used, the address needs certificates, or cannot be listened at.
    """
    if certificates is None and not _is_loopback(host):
        raise SceneError(
            f"{host} can be reached by other machines, which needs certificates: give --certificate and --key "
            "(and --client-ca to let in only clients that have one too), or leave the address out"
        )
    credentials = None if certificates is None else certificates.credentials()
    chassis = connect_scene(scene, clock)
    tell_unfed_sensors(chassis)
    with contextlib.ExitStack() as stack:
        try:
            server = Server(chassis, f"{host}:{port}", credentials, limits, (BenchTime(chassis),))
        except RuntimeError:
            raise SceneError(f"cannot listen at {host}:{port}: choose another port with --port") from None
        stack.callback(server.close)
        if record is not None:
            stack.callback(LiveRecording(chassis, record, overwrite).close)
        if viewer:
            stack.enter_context(_viewing(chassis))
        # Python's collector would look through all that is there by now, time and again, while every client waits.
        gc.collect()
        gc.freeze()
        print(announcement(chassis, host, server.port, certificates is not None), flush=True)
        _wait_for_signal()
        print("closing", file=sys.stderr)


def announcement(chassis: Chassis, host: str, port: int, encrypted: bool) -> str:
    """Say where the rig is, what is on it, and how a script reaches it."""
    lines = [f"Server listening on port {port} ({host}:{port}{', with TLS' if encrypted else ''})", ""]
    modules = [chassis.devices.module(name) for name in chassis.devices.names]
    for module in modules:
        kinds = [each for kind in ("ai", "ao") if (each := _span(module.channel_names(kind)))]
        lines.append(f"{module.name}: {module.product_type}" + (f", {', '.join(kinds)}" if kinds else ""))
        for terminal, row in zip(module.channel_names("ai"), module.inputs, strict=True):
            info = chassis.source.channels[row]
            fed = "" if chassis.source.supply(row) is None else ", IEPE"
            lines.append(
                f"  {terminal}: {info.name} at {info.at}, {1e3 * info.sensitivity:.4g} mV per {info.unit}{fed}"
            )
    opened = "grpc.insecure_channel" if not encrypted else "grpc.secure_channel"
    extra = "" if not encrypted else ', grpc.ssl_channel_credentials(open("ca.pem", "rb").read())'
    return "\n".join([*lines, *starter_script(chassis, f'{opened}("{host}:{port}"{extra})')])


def _span(names: list[str]) -> str:
    if not names:
        return ""
    first = names[0].partition("/")[2]
    return first if len(names) == 1 else f"{first}:{len(names) - 1}"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _wait_for_signal() -> None:
    ended = threading.Event()
    # Under nohup it is to serve on.
    heard = [
        each for each in ENDINGS if each == signal.SIGINT or signal.getsignal(each) is not signal.SIG_IGN
    ]
    before = {each: signal.signal(each, lambda *_: ended.set()) for each in heard}
    try:
        while not ended.wait(0.5):
            pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _viewing(chassis: Chassis) -> Any:
    from daq.replay import outputs

    with (
        outputs.window("leave --viewer out to serve without it") as running,
        outputs.recording_stream() as stream,
    ):
        stream.connect_grpc(running.url)
        with contextlib.closing(LiveView(chassis, stream)):
            yield
