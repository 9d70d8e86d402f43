"""Show a running search to browsers on this machine: Drake's Meshcat, and plots of cost and violation.

Only the thread that created a Meshcat may use it, and the process ends if another thread deletes it. Therefore one
thread creates one Meshcat, draws all scenes, and runs until the process ends. It draws only the latest scene, so a slow
or closed browser does not delay the search.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import numpy as np
from pydrake.geometry import HalfSpace, Meshcat, MeshcatParams, Rgba

from drake_diff.pages.html import asset, numbers
from drake_diff.pages.meshcat import Stills, draw
from drake_diff.pages.scene import Scene

HOST = "127.0.0.1"
PATIENCE = 5.0  # [s] longest time for which a finished search waits until its motion is drawn
GROUND = Rgba(0.867, 0.882, 0.902, 1)  # as on other pages, because most robots are grey
ASSETS = {
    "uPlot.iife.min.js": "text/javascript",
    "live.js": "text/javascript",
    "uPlot.min.css": "text/css",
    "report.css": "text/css",
    "live.css": "text/css",
}
POLICY = "default-src 'self'; img-src data:; object-src 'none'; base-uri 'none'; form-action 'none'"


class LivePage:
    """The page of this process, which shows the search that was begun last."""

    def __init__(self) -> None:
        self.process, self._changed = os.getpid(), threading.Condition()
        self._number, self._rows, self._told = 0, list[list[float | None]](), dict[str, Any]()
        self._starts = list[int]()  # indices of the rows that begin a solver's table
        self._next: tuple[int, Scene, bool] | None = None  # the number of its search, and whether it is the final scene
        self._drawing, self.viewer, self._begun = False, "", 0.0
        made = threading.Event()
        threading.Thread(target=self._draw, args=[made], name="drake_diff live view", daemon=True).start()
        made.wait()
        self._server = _Server(self)
        threading.Thread(target=self._server.serve_forever, name="drake_diff live page", daemon=True).start()

    @property
    def address(self) -> str:
        """The address for a browser on this machine."""
        return f"http://{HOST}:{self._server.server_port}/"

    @property
    def is_busy(self) -> bool:
        """Whether a scene is being drawn or waits to be drawn."""
        return self._next is not None or self._drawing

    def viewer_page(self) -> str:
        """Return Meshcat's page, connected to Meshcat; this server serves it, so that our slider can access it."""
        with urlopen(self.viewer, timeout=10) as answer:
            page = str(answer.read().decode())
        there = self.viewer.rstrip("/") + "/"
        socket = f"class extends WebSocket {{ constructor() {{ super({there.replace('http', 'ws', 1)!r}); }} }}"
        return page.replace("<head>", f'<head><base href="{there}"><script>WebSocket = {socket};</script>', 1)

    def begin(self, title: str, colours: Sequence[tuple[str, str, str]]) -> int:
        """Show another search; return the number that identifies its scenes and rows.

        `colours` is the legend: a CSS colour, "line", "dot" or "arrow", and the meaning.
        """
        with self._changed:
            self._number += 1
            self._rows, self._starts, self._next, self._begun = [], [], None, time.monotonic()
            self._told = {"title": title, "colours": [*colours], "state": "searching", "line": "", "message": ""}
            return self._number

    def show(self, number: int, scene: Scene, *, end: bool = False) -> None:
        """Draw some states of `scene` at the same time, or at the `end` all of it as an animation."""
        with self._changed:
            if number == self._number:
                self._next = number, scene, end
                self._changed.notify_all()

    def add(self, number: int, iteration: int, cost: float, violation: float) -> None:
        """Add a row of the solver's table."""
        with self._changed:
            if number == self._number:
                if iteration <= self._told.get("iteration", iteration):
                    self._starts.append(len(self._rows))
                self._rows.append(numbers([cost, violation]))
                self._told["iteration"] = iteration

    def tell(self, number: int, **facts: Any) -> None:
        """Set the state, the message, the last line of progress, or the verdict at the end."""
        with self._changed:
            if number == self._number:
                if "verdict" in facts:
                    facts["seconds"] = time.monotonic() - self._begun
                self._told |= facts

    def wait(self, seconds: float | None = None) -> bool:
        """Wait up to `seconds`, by default PATIENCE, until everything is drawn; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self.is_busy, PATIENCE if seconds is None else seconds)

    def news(self, number: int, known: int) -> dict[str, Any]:
        """Return the news for a page that has `known` rows of the search `number`."""
        with self._changed:
            first = known if number == self._number else 0
            facts = {"number": self._number, "first": first, "rows": self._rows[first:], "starts": [*self._starts]}
            return {"seconds": time.monotonic() - self._begun, **self._told, **facts}

    def _draw(self, made: threading.Event) -> None:
        meshcat = Meshcat(MeshcatParams(host=HOST, show_stats_plot=False))
        self.viewer = meshcat.web_url()
        made.set()
        stills: tuple[int, Stills] | None = None
        while True:
            number, scene, end = self._taken()
            paved = [replace(s, colour=GROUND) if isinstance(s.shape, HalfSpace) else s for s in scene.shapes]
            scene = replace(scene, shapes=tuple(paved))
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # diverged motions
                    if end:
                        stills = None
                        meshcat.Delete()
                        meshcat.DeleteRecording()
                        draw(meshcat, scene)
                    elif stills is None or stills[0] != number:
                        meshcat.DeleteRecording()
                        stills = number, Stills(meshcat, scene)
                    else:
                        stills[1].show(scene)
            except Exception as error:  # any error of Drake about a shape; the search continues
                self.tell(number, line=f"the motion cannot be drawn: {type(error).__name__}: {error}")
            with self._changed:
                self._drawing = False
                self._changed.notify_all()

    def _taken(self) -> tuple[int, Scene, bool]:
        """Wait for the next scene to draw, and return it."""
        with self._changed:
            while self._next is None:
                self._changed.wait()
            result, self._next, self._drawing = self._next, None, True
            return result


_PAGES: list[LivePage] = []  # at most one
_MAKING = threading.Lock()


def live_page() -> LivePage:
    """Return the page of this process; it is created once, so an open tab also shows the next search."""
    with _MAKING:
        if not _PAGES or _PAGES[0].process != os.getpid():  # a fork does not have the threads
            _PAGES[:] = [LivePage()]
        return _PAGES[0]


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, page: LivePage):
        self.page = page
        super().__init__((HOST, 0), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):  # a closed browser is not an error
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        port = self.server.server_port
        if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
            self.send_error(403)  # a foreign page whose host name resolves to this server
            return
        asked = urlsplit(self.path)
        name = asked.path[1:]
        if name == "":
            self._send("text/html", asset("live.html"), {"Content-Security-Policy": POLICY})
        elif name in ASSETS:
            self._send(ASSETS[name], asset(name), {})
        elif name == "viewer":
            self._send("text/html", self.server.page.viewer_page(), {})
        elif name == "news":
            self._send_news(parse_qs(asked.query))
        else:
            self.send_error(404)

    def _send_news(self, asked: dict[str, list[str]]) -> None:
        try:
            number, known = (int(asked.get(name, ["0"])[0]) for name in ("number", "known"))
        except ValueError:
            self.send_error(400)
            return
        self._send("application/json", json.dumps(self.server.page.news(number, max(0, known))), {})

    def _send(self, kind: str, text: str, headers: dict[str, str]) -> None:
        data = text.encode()
        self.send_response(200)
        more = {"Content-Length": str(len(data)), "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        for name, value in {"Content-Type": f"{kind}; charset=utf-8", **more, **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Do nothing: a page asks for news twice a second."""
