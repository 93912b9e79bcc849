"""The web application of `daq bench`: page, scripts, messages to the browser, commands from it, and reports."""

import asyncio
import contextlib
import math
import sys
import time
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from daq.extras.bench_page.live_bench import LiveBench
from daq.extras.bench_page.page import REFRESH_S, Page
from rig.core.base.output_files import temporary_folder

_BROWSER = Path(__file__).parent / "browser"


class Application:
    """The pages of a bench; `asgi` is the application for the web server."""

    def __init__(self, bench: LiveBench) -> None:
        self._bench = bench
        self.asgi = Starlette(
            routes=[
                Route("/", lambda _: FileResponse(_BROWSER / "bench.html")),
                Route("/report/{number:int}", self._report),
                WebSocketRoute("/live", self._live),
                Mount("/browser", StaticFiles(directory=_BROWSER)),
            ]
        )

    async def _live(self, socket: WebSocket) -> None:
        await socket.accept()
        page = Page(self._bench)
        await socket.send_bytes(page.description())
        sender = asyncio.create_task(self._send(socket, page))
        try:
            while True:
                name, value = await socket.receive_json()
                # A test may compile kernels at its start, which takes seconds.
                await run_in_threadpool(self._obey, page, name, value)
                page.obeyed += 1
                if name == "theory":
                    await socket.send_bytes(await run_in_threadpool(page.theory))
        except (WebSocketDisconnect, ValueError, TypeError, LookupError, OverflowError, RuntimeError):
            # The browser has closed the page, or another program has sent a malformed command.
            pass
        finally:
            sender.cancel()

    async def _send(self, socket: WebSocket, page: Page) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            due = time.monotonic()
            while True:
                await socket.send_bytes(await run_in_threadpool(page.refresh))
                due = max(due + REFRESH_S, time.monotonic())
                await asyncio.sleep(due - time.monotonic())

    def _obey(self, page: Page, name: str, value: Any) -> None:
        """Carry out a command of the browser."""
        controller, monitor = self._bench.controller, self._bench.monitor
        if name == "start":
            controller.start()
        elif name == "hit" and controller.has_hammer:
            controller.start(single_impact=True)
        elif name == "stop":
            controller.stop()
        elif name == "record":
            self._bench.recordings.enabled = bool(value)
        elif name == "span":
            page.span = min(max(_number(value) or 0.0, 0.05), 10.0)
        elif name == "clear":
            monitor.overloads.clear()
        elif name == "accept" and monitor.detector is not None:
            number, accepted = value
            monitor.detector.impacts[int(number) - 1].accepted = bool(accepted)
        elif name in vars(controller.settings):
            setattr(controller.settings, name, value if name == "kind" else _number(value))
            controller.apply_settings()

    async def _report(self, request: Request) -> Response:
        """Return the report of a recording, made by the command `analysis report`.

        This package must not import `analysis`.
        """
        paths, number = self._bench.recordings.paths, request.path_params["number"]
        if not 0 < number <= len(paths):
            return PlainTextResponse("There is no such recording.", 404)
        with temporary_folder() as folder:
            output = folder / "report.html"
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "analysis", "report", str(paths[number - 1]), "-o", str(output),
                stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
            _, errors = await process.communicate()
            if not output.exists():
                return PlainTextResponse(errors.decode(errors="replace"), 500)
            return Response(output.read_bytes(), media_type="text/html")


def _number(value: Any) -> float | None:
    """Return the number of a field; None if it is empty or not a finite number, which JSON cannot represent.

    >>> _number("2.5"), _number(""), _number(float("nan"))
    (2.5, None, None)
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None
