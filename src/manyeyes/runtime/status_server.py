# SPDX-License-Identifier: Apache-2.0
"""HTTP endpoint of a live agent: /metrics for Prometheus, /healthz for a supervisor (200, or 503 with the reason)."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from manyeyes.datatypes import ConfigError
from manyeyes.runtime.metrics import LiveMetrics

_TEXT = "text/plain; charset=utf-8"
_REQUEST_S = 5.0


class StatusServer:
    """Serves the metrics of a run in a thread of its own.

    Raises:
        ConfigError: the address is not HOST:PORT, or cannot be used.
    """

    def __init__(self, address: str, metrics: LiveMetrics) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ConfigError(f"An address is HOST:PORT, such as 127.0.0.1:9464; got {address!r}.")
        try:
            self._server = ThreadingHTTPServer((host, int(port)), _make_handler(metrics))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"Metrics on {address}: {error}.") from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="status", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port, where the address had port 0."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop the server and close its socket."""
        self._server.shutdown()
        self._server.server_close()


def _make_handler(metrics: LiveMetrics) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _REQUEST_S

        def do_GET(self) -> None:
            if self.path == "/metrics":
                self._send(200, "text/plain; version=0.0.4; charset=utf-8", metrics.text())
            elif self.path == "/healthz":
                fault = metrics.fault()
                self._send(503 if fault else 200, _TEXT, (fault or "healthy").encode() + b"\n")
            else:
                self._send(404, _TEXT, b"/metrics or /healthz\n")

        def _send(self, status: int, kind: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *_: object) -> None:
            """Log nothing: requests come every few seconds."""

    return Handler
