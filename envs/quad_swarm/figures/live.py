"""A page that follows a flight: that of `sb3-maddpg replay`, fed by server-sent events, on this machine alone."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

from quad_swarm.evaluation.real_time import recorded
from quad_swarm.figures.replay import live_page, live_step
from quad_swarm.realtime.process import Sample
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.scenarios import Scene

_WAIT = 1.0  # s after which a connection without news is tested
_FIRST = 60.0  # s that a page waits for a flight to begin


class LivePage:
    """Serves the page of the current flight. Use it as a context, which ends the server.

    :ivar url: address of the page

    :param config: the world
    :param port: port, by default any that is free
    :raises OSError: if the port is taken
    """

    def __init__(self, config: SwarmConfig, port: int = 0):
        self._config, self._news = config, threading.Condition()
        self._number, self._over, self._closed = 0, True, False
        self._samples: list[Sample] = []
        self._server = ThreadingHTTPServer(("127.0.0.1", port), self._handler())
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="live page", daemon=True)
        self._thread.start()

    def __enter__(self) -> LivePage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(self, policy: str, scene: Scene) -> None:
        """Begin to show a flight.

        :param policy: what flies
        :param scene: the episode
        """
        with self._news:
            self._number, self._over, self._samples = self._number + 1, False, []
            self._policy, self._scene = policy, scene
            self._news.notify_all()

    def add(self, sample: Sample) -> None:
        """Show the next period."""
        with self._news:
            self._samples.append(sample)
            self._news.notify_all()

    def end(self) -> None:
        """Say that the flight is over; the page stays."""
        with self._news:
            self._over = True
            self._news.notify_all()

    def close(self) -> None:
        """End the server."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def page(self) -> str | None:
        """Return the page of the flight so far, None if none begins within a minute."""
        with self._news:
            if not self._news.wait_for(lambda: len(self._samples) > 1 or self._closed, _FIRST) or self._closed:
                return None
            samples, policy, number = list(self._samples), self._policy, self._number
        return live_page(policy, recorded(samples, self._config, self._scene, policy).flight(), number)

    def events(self, number: int, known: int) -> Iterator[str]:
        """Yield events: the steps of a flight, its end, and the beginning of the next; or an empty one now and then.

        :param number: number of the flight
        :param known: number of steps that are known
        """
        while True:
            with self._news:
                self._news.wait_for(partial(self._differs, number, known), _WAIT)
                if self._closed:
                    return
                if number != self._number:
                    yield "event: begin\ndata: \n\n"
                    return
                samples, over = self._samples[known : known + 2], self._over
            if len(samples) == 2:
                known += 1
                step = live_step(recorded(samples, self._config, self._scene, "").flight())
                yield f"id: {known}\ndata: {json.dumps(step, separators=(',', ':'))}\n\n"
            elif over:
                yield "event: end\ndata: \n\n"
                with self._news:
                    self._news.wait_for(lambda: self._closed or number != self._number)
            else:
                yield ": nothing yet\n\n"

    def _differs(self, number: int, known: int) -> bool:
        return self._closed or number != self._number or len(self._samples) > known + 1 or self._over

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        live = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                path = urlsplit(self.path)
                if path.path == "/":
                    page = live.page()
                    if page is None:
                        self.send_error(503, "No flight")
                        return
                    data = page.encode("utf-8")
                    self._head("text/html; charset=utf-8", len(data))
                    self.wfile.write(data)
                elif path.path == "/events":
                    self._stream(parse_qs(path.query))
                else:
                    self.send_error(404)

            def _stream(self, query: dict[str, list[str]]) -> None:
                try:
                    number = int(query["flight"][0])
                    known = int(self.headers.get("Last-Event-ID") or query["from"][0])
                except (KeyError, ValueError):
                    self.send_error(400)
                    return
                self._head("text/event-stream")
                try:
                    for event in live.events(number, max(known, 0)):
                        self.wfile.write(event.encode("utf-8"))
                except OSError:  # the page has been closed
                    return

            def _head(self, kind: str, length: int | None = None) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Cache-Control", "no-store")
                if length is not None:
                    self.send_header("Content-Length", str(length))
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                """Print nothing."""

        return Handler
