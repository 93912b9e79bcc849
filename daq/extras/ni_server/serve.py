"""Server of a rig for other processes and computers: `daq serve`."""

import contextlib
import gc
import ipaddress
import re
import signal
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import grpc

from daq.core.signal_chain.converter import describe_output
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_server.bench_time import BenchTime
from daq.extras.ni_server.live import LiveRecording
from daq.extras.ni_server.served_instrument import Limits
from daq.extras.ni_server.service import Server
from daq.extras.ni_server.starter_script import report_missing_excitation, starter_script
from rig.core.base.ending_signals import TERMINATION_SIGNALS
from rig.core.base.errors import SceneError
from rig.core.base.input_files import read_file
from rig.core.scene.scene import Scene

# Number of allocations between runs of the cyclic garbage collector; a closed task leaves about 40 objects.
_GC_THRESHOLD = 10_000


@dataclass(frozen=True)
class Certificates:
    """Certificate files in PEM format."""

    certificate: Path  # certificate chain of the server
    key: Path  # private key of the server
    clients: Path | None = None  # certificate of the authority that signs clients' certificates; None: not required

    def credentials(self) -> grpc.ServerCredentials:
        """Read the files; raises `SceneError` if a file cannot be read."""
        contents = []
        for path in (self.key, self.certificate, *([] if self.clients is None else [self.clients])):
            try:
                contents.append(read_file(path))
            except OSError as error:
                raise SceneError(f"cannot read {path}: {error.strerror}. Give a PEM file.") from None
        client_authority = None if self.clients is None else contents[2]
        return grpc.ssl_server_credentials(
            [(contents[0], contents[1])], client_authority, require_client_auth=client_authority is not None
        )


def serve(
    scene: Scene | str | None = None,
    clock: str | None = None,
    host: str = "127.0.0.1",
    port: int = 31763,
    certificates: Certificates | None = None,
    limits: Limits | None = None,
    record: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Serve a rig until Ctrl-C, SIGTERM or the end of its terminal.

    Parameters
    ----------
    scene, clock : as in `daq.connect`
        The rig, and the clock that advances it.
    host : str
        Address to listen on; other machines can connect only with certificates. An IPv6 address may be in brackets, and
        a port may follow the host.
    port : int
        Port; 0 selects a free port.
    certificates : Certificates, optional
        Required for addresses that other computers can reach.
    limits : Limits, optional
        Limits of the resources of clients.
    record : Path, optional
        Recording of all channels during the session.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    SceneError
        If the scene cannot be used, or the address requires certificates or is not available.
    RunError
        At the end, if the recording or the simulation has ended by an error.
    """
    host, port = parse_address(host, port)
    if certificates is None and not _is_loopback(host):
        raise SceneError(
            f"{host}: this address requires certificates, because other machines can reach it. Give `certificates` "
            "(with a CA of the clients, only clients with a certificate are admitted), or omit the address."
        )
    credentials = None if certificates is None else certificates.credentials()
    chassis = connect_scene(scene, clock)
    report_missing_excitation(chassis)
    with contextlib.ExitStack() as stack:
        try:
            server = Server(chassis, _endpoint(host, port), credentials, limits, (BenchTime(chassis),))
        except RuntimeError:
            raise SceneError(f"cannot listen at {_endpoint(host, port)}. Choose another `port` or `host`.") from None
        stack.callback(server.close)
        if record is not None:
            stack.callback(LiveRecording(chassis, record, overwrite).close)
        collect_garbage_often()
        print(announcement(chassis, host, server.port, certificates is not None), flush=True)
        wait_for_signal()
        print("closing", file=sys.stderr)
    chassis.raise_problems()


def collect_garbage_often() -> None:
    """Run the garbage collector more often than commands do: closed tasks would occupy hundreds of MB.

    Objects that exist now are exempt, because scanning them would delay clients.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(_GC_THRESHOLD)


def announcement(chassis: Chassis, host: str, port: int, encrypted: bool) -> str:
    """Return the text that `daq serve` prints: address, devices with their channels, and a script for clients."""
    address = _endpoint(host, port)
    lines = [f"Server listening on port {port} ({address}{', with TLS' if encrypted else ''})", ""]
    modules = [chassis.devices.module(name) for name in chassis.devices.names]
    for module in modules:
        ranges = []  # range of channel names, such as "ai0:3"
        for names in (module.channel_names("ai"), module.channel_names("ao")):
            last = f":{len(names) - 1}" if len(names) > 1 else ""
            ranges += [f"{name.partition('/')[2]}{last}" for name in names[:1]]
        lines.append(", ".join([f"{module.name}: {module.product_type}", *ranges]))
        for terminal, bench_index in zip(module.channel_names("ai"), module.inputs, strict=True):
            info = chassis.bench.channels[bench_index]
            supply_note = "" if chassis.terminals.supply(bench_index) is None else ", IEPE"
            place = chassis.bench.scene.structure.label(info.at)
            lines.append(
                f"  {terminal}: {info.name} at {place}, {1e3 * info.sensitivity:.4g} mV per {info.unit}{supply_note}"
            )
        for terminal, bench_index in zip(module.channel_names("ao"), module.outputs, strict=True):
            lines.append(f"  {terminal}: {describe_output(chassis.bench.scene, bench_index + 1)}")
    channel_function = "grpc.insecure_channel" if not encrypted else "grpc.secure_channel"
    credentials_argument = "" if not encrypted else ', grpc.ssl_channel_credentials(open("ca.pem", "rb").read())'
    return "\n".join([*lines, *starter_script(chassis, f'{channel_function}("{address}"{credentials_argument})')])


def parse_address(address: str, port: int) -> tuple[str, int]:
    """Return host and port of an address; an IPv6 address may be in brackets, and `port` is the default port.

    Raises `SceneError` if the part after the host is not a port.

    >>> parse_address("::1", 31763), parse_address("[::1]:4000", 31763), parse_address("localhost:0", 31763)
    (('::1', 31763), ('::1', 4000), ('localhost', 0))
    """
    match = re.fullmatch(
        r"\[(?P<ipv6>[^\[\]]*)\](?P<ipv6_port>:.*)?|(?P<bare_ipv6>[^\[\]]*:[^\[\]]*:[^\[\]]*)|"
        r"(?P<name>[^:\[\]]*)(?P<name_port>:.*)?",
        address,
    )
    host = match and (match["ipv6"] or match["bare_ipv6"] or match["name"])
    digits = match and (match["ipv6_port"] or match["name_port"] or "")[1:]
    if not host or (digits and not (digits.isdecimal() and int(digits) < 65536)):
        raise SceneError(f"address {address!r} is not valid. Give HOST, HOST:PORT or [IPV6]:PORT.")
    return host, int(digits) if digits else port


def _endpoint(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_loopback(host: str) -> bool:
    """Return whether all addresses of a host are loopback addresses."""
    try:
        addresses = {str(info[4][0]).partition("%")[0] for info in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):
        return False
    return bool(addresses) and all(ipaddress.ip_address(address).is_loopback for address in addresses)


def wait_for_signal() -> None:
    """Wait for Ctrl-C, SIGTERM or the end of the terminal."""
    ended = threading.Event()
    # Under nohup, SIGHUP is ignored and must remain ignored, so the server continues.
    signals = [
        number
        for number in TERMINATION_SIGNALS
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN
    ]
    previous_handlers = {number: signal.signal(number, lambda *_: ended.set()) for number in signals}
    try:
        while not ended.wait(0.5):
            pass
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
