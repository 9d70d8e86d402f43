"""A search as it goes on, for browsers on this machine alone: Drake's Meshcat beside plots of cost and violation.

Drake lets only the thread that made a Meshcat use it, and ends the process where another one lets it go. So one thread
makes one Meshcat, draws whatever it is given, and stays until the process ends. It draws the latest scene alone: a
browser that is slow, or gone, keeps nobody waiting.
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
PATIENCE = 5.0  # [s] that a search which has ended waits until its motion is drawn
GROUND = Rgba(0.867, 0.882, 0.902, 1)  # as on other pages: most robots are grey
ASSETS = {
    "uPlot.iife.min.js": "text/javascript",
    "live.js": "text/javascript",
    "uPlot.min.css": "text/css",
    "report.css": "text/css",
    "live.css": "text/css",
}
POLICY = "default-src 'self'; img-src data:; object-src 'none'; base-uri 'none'; form-action 'none'"


class LivePage:
    """The page of this process; it shows one search at a time, the last that was begun."""

    def __init__(self) -> None:
        self.process, self._changed = os.getpid(), threading.Condition()
        self._number, self._rows, self._told = 0, list[list[float | None]](), dict[str, Any]()
        self._starts = list[int]()  # which rows are the first of a solver's own table
        self._next: tuple[int, Scene, bool] | None = None  # the number of its search, and whether it is the end's
        self._drawing, self.viewer, self._begun = False, "", 0.0
        made = threading.Event()
        threading.Thread(target=self._draw, args=[made], name="drake_diff live view", daemon=True).start()
        made.wait()
        self._server = _Server(self)
        threading.Thread(target=self._server.serve_forever, name="drake_diff live page", daemon=True).start()

    @property
    def address(self) -> str:
        """What a browser on this machine opens."""
        return f"http://{HOST}:{self._server.server_port}/"

    @property
    def is_busy(self) -> bool:
        """Whether a scene waits to be drawn, or is drawn."""
        return self._next is not None or self._drawing

    def viewer_page(self) -> str:
        """Meshcat's page for our frame: from here, so that our slider reaches into it, and connected to Meshcat."""
        with urlopen(self.viewer, timeout=10) as answer:
            page = str(answer.read().decode())
        there = self.viewer.rstrip("/") + "/"
        socket = f"class extends WebSocket {{ constructor() {{ super({there.replace('http', 'ws', 1)!r}); }} }}"
        return page.replace("<head>", f'<head><base href="{there}"><script>WebSocket = {socket};</script>', 1)

    def begin(self, title: str, colours: Sequence[tuple[str, str, str]]) -> int:
        """Show another search from now on; the number that tells its scenes and rows from those of others.

        `colours` are the legend: a colour of CSS, "line", "dot" or "arrow", and what it means.
        """
        with self._changed:
            self._number += 1
            self._rows, self._starts, self._next, self._begun = [], [], None, time.monotonic()
            self._told = {"title": title, "colours": [*colours], "state": "searching", "line": "", "message": ""}
            return self._number

    def show(self, number: int, scene: Scene, *, end: bool = False) -> None:
        """Draw some states of `scene` at once, or at the `end` all of it, to be played."""
        with self._changed:
            if number == self._number:
                self._next = number, scene, end
                self._changed.notify_all()

    def add(self, number: int, iteration: int, cost: float, violation: float) -> None:
        """A row of the solver's table."""
        with self._changed:
            if number == self._number:
                if iteration <= self._told.get("iteration", iteration):
                    self._starts.append(len(self._rows))
                self._rows.append(numbers([cost, violation]))
                self._told["iteration"] = iteration

    def tell(self, number: int, **facts: Any) -> None:
        """State, message, the last line of progress, and a verdict when it ends."""
        with self._changed:
            if number == self._number:
                if "verdict" in facts:
                    facts["seconds"] = time.monotonic() - self._begun
                self._told |= facts

    def wait(self, seconds: float | None = None) -> bool:
        """Until all that was given is drawn, but for PATIENCE at most where no `seconds` are given; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self.is_busy, PATIENCE if seconds is None else seconds)

    def news(self, number: int, known: int) -> dict[str, Any]:
        """What a page is told that knows `known` rows of the search `number`."""
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
                with np.errstate(over="ignore", invalid="ignore"):  # of motions that leave every finite number
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
            except Exception as error:  # whatever Drake says of a shape: the search is not to end by it
                self.tell(number, line=f"the motion cannot be drawn: {type(error).__name__}: {error}")
            with self._changed:
                self._drawing = False
                self._changed.notify_all()

    def _taken(self) -> tuple[int, Scene, bool]:
        """What is to be drawn next, when there is something."""
        with self._changed:
            while self._next is None:
                self._changed.wait()
            result, self._next, self._drawing = self._next, None, True
            return result


_PAGES: list[LivePage] = []  # one at most
_MAKING = threading.Lock()


def live_page() -> LivePage:
    """The page of this process, made when it is first asked for: a tab that shows one search shows the next one too."""
    with _MAKING:
        if not _PAGES or _PAGES[0].process != os.getpid():  # a fork has none of the threads
            _PAGES[:] = [LivePage()]
        return _PAGES[0]


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, page: LivePage):
        self.page = page
        super().__init__((HOST, 0), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):  # a browser that was closed is no error
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        port = self.server.server_port
        if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
            self.send_error(403)  # a stranger's page whose name leads here
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
        """A page that asks for news twice a second is nothing to tell."""
