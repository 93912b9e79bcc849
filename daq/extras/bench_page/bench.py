"""The function `daq.bench`: serves the instrument to NI clients, and its page to browsers."""

import contextlib
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

from daq.extras.bench_page.live_bench import LiveBench
from daq.extras.ni_device.connecting import connect_scene
from daq.extras.ni_server.bench_time import BenchTime
from daq.extras.ni_server.serve import collect_garbage_often, parse_address, wait_for_signal
from daq.extras.ni_server.service import Server
from rig.core.base.errors import RunError, SceneError
from rig.core.base.output_files import temporary_folder
from rig.core.scene.scene import Scene

# Longest time [s] for the start of the web server, even on a loaded computer.
_MAX_START_S = 30.0
# Maximum size of a command of the page [bytes]; the largest command has less than 100 bytes.
_MAX_COMMAND_BYTES = 1 << 16
# With these headers, no page of another origin can show this page, load its files from the browser's cache, or keep a
# handle of its window.
_HEADERS = [
    ("x-frame-options", "DENY"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cross-origin-opener-policy", "same-origin"),
]


def bench(
    scene: Scene | str | None = None,
    host: str = "127.0.0.1",
    port: int = 8031,
    device_port: int = 31763,
    recording: str | Path = "recordings/bench.mcap",
    overwrite: bool = False,
    browser: bool = True,
) -> None:
    """Serve a rig to NI clients, and its page to browsers, until Ctrl-C.

    Parameters
    ----------
    scene : Scene, str or None
        Scene of the rig; see `daq.connect`.
    host : str
        Address of the page; a browser needs the printed token.
    port : int
        Port of the page; 0 selects a free port.
    device_port : int
        Port of the device for NI clients; 0 selects a free port.
    recording : str or Path
        File of the first recording that the switch on the page starts; further files are numbered.
    overwrite : bool
        Whether the first recording may replace an existing file.
    browser : bool
        Open the page in the browser.

    Raises
    ------
    RunError
        If Starlette or Uvicorn is missing; at the end, if a recording or the simulation has ended by an error.
    SceneError
        If the scene cannot be used or an address is not available.
    """
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise RunError(f"the page needs {error.name}, which is missing. Run: pip install 'shotrig[bench]'") from None
    host, port = parse_address(host, port)
    chassis = connect_scene(scene, "real")
    with contextlib.ExitStack() as stack:
        try:
            server = Server(chassis, f"127.0.0.1:{device_port}", other_handlers=(BenchTime(chassis),))
        except RuntimeError:
            raise SceneError(
                f"port {device_port} on 127.0.0.1 is in use. Choose another port with `device_port`; 0 selects a free "
                f"port."
            ) from None
        stack.callback(server.close)
        live_bench = LiveBench(chassis, f"127.0.0.1:{server.port}", Path(recording), overwrite)
        stack.callback(live_bench.close)
        address = stack.enter_context(_serve_page(live_bench, host, port))
        collect_garbage_often()
        print(f"{address}\nNI clients: 127.0.0.1:{server.port}. Ctrl-C ends the bench.", flush=True)
        if browser:
            _open_browser(address, stack.enter_context(temporary_folder()))
        wait_for_signal()
        monitor, end = live_bench.monitor, "the bench has ended"
        if monitor.lost_samples:
            end += f"; {monitor.lost_samples} samples were lost"
        if monitor.skipped_blocks:
            end += f"; {monitor.skipped_blocks} blocks of samples were not shown on the page, but are in the recordings"
        print(end, file=sys.stderr)
    for path in live_bench.recordings.paths:
        print(path)
    chassis.raise_problems()


def _open_browser(address: str, folder: Path) -> None:
    """Open an address in the browser through a private file; all users can see the arguments of a browser process."""
    import webbrowser

    page = folder / "bench.html"
    page.write_text(f'<meta http-equiv="refresh" content="0; url={address}">', encoding="utf-8")
    webbrowser.open(page.as_uri())


@contextlib.contextmanager
def _serve_page(live_bench: LiveBench, host: str, port: int) -> Any:
    """Serve the page from a thread; yield its address, which contains the token."""
    import uvicorn

    from daq.extras.bench_page.access import MAX_CONNECTIONS, LimitedConnection, TokenGate
    from daq.extras.bench_page.application import Application

    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family)
    except (OSError, UnicodeError):
        raise SceneError(f"cannot listen at {host}:{port}. Choose another `port` or `host`.") from None
    bound_port = listener.getsockname()[1]
    token_gate = TokenGate(Application(live_bench).asgi, host, f"shotrig_bench_{bound_port}")
    config = uvicorn.Config(
        token_gate,
        http=LimitedConnection,
        backlog=MAX_CONNECTIONS,
        headers=_HEADERS,
        ws_max_size=_MAX_COMMAND_BYTES,
        log_level="critical",
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)

    def run() -> None:
        server.run(sockets=[listener])
        if not server.should_exit:
            live_bench.chassis.report_problem(
                "the page", RunError("the web server has stopped. Start the bench again.")
            )

    thread = threading.Thread(target=run, name="page", daemon=True)
    thread.start()
    deadline = time.monotonic() + _MAX_START_S
    while not server.started and thread.is_alive() and time.monotonic() < deadline:
        thread.join(0.05)
    if not server.started:
        raise RunError(f"the page did not start within {_MAX_START_S:g} s. Start the bench again.")
    url_host = f"[{host}]" if ":" in host else host
    try:
        yield f"http://{url_host}:{bound_port}/?token={token_gate.token}"
    finally:
        server.should_exit = True
        thread.join(5.0)
