# SPDX-License-Identifier: Apache-2.0
"""The web viewer of rerun as a process of this machine, for browsers of this machine alone."""

from __future__ import annotations

import socket
import subprocess
import time
from pathlib import Path
from types import TracebackType

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.extras import import_extra

WEB, DEFAULT_PORT, HOST = "web", 9090, "127.0.0.1"
_START_S, _STOP_S = 30.0, 5.0


def is_web_target(target: str) -> bool:
    """Return whether a target names the web viewer: web, or web:PORT."""
    return target == WEB or target.startswith(f"{WEB}:")


class RerunServer:
    """Serves the web viewer on a port of the loopback interface, and takes frames at ``url``; it ends when it is closed.

    Raises:
        ConfigError: the port is none, or is taken, or the viewer does not start.
        MissingExtraError: rerun is not installed.
    """

    def __init__(self, target: str) -> None:
        _, _, text = target.partition(":")
        port = DEFAULT_PORT if target == WEB else int(text) if text.isdecimal() else 0
        if not 1 <= port <= 65_535:
            raise ConfigError(f"The web viewer is web:PORT, with a port from 1 to 65535; got {target!r}.")
        program = Path(import_extra("rerun_cli", "rerun", "The web viewer").__file__).with_name("rerun")
        if not _is_free(port):
            raise ConfigError(f"Port {port} of {HOST} is taken; choose another one: web:{port % 65_535 + 1}.")
        self._proxy_port = _find_free_port()
        self._process = subprocess.Popen(
            [program, "--serve-web", "--bind", HOST, "--port", str(self._proxy_port), "--web-viewer-port", str(port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.url = f"rerun+http://{HOST}:{self._proxy_port}/proxy"
        self.page = f"http://{HOST}:{port}/?url=rerun%2Bhttp%3A%2F%2F{HOST}%3A{self._proxy_port}%2Fproxy"
        try:
            self._await_ports((port, self._proxy_port))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> RerunServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def wait(self) -> None:
        """Wait until the viewer ends."""
        self._process.wait()

    def close(self) -> None:
        """End the process of the viewer."""
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _await_ports(self, ports: tuple[int, ...]) -> None:
        end = time.monotonic() + _START_S
        while any(_is_free(port) for port in ports):
            if self._process.poll() is not None or time.monotonic() > end:
                raise ConfigError("The web viewer does not start; 'rerun --serve-web' prints why.")
            time.sleep(0.05)


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((HOST, port)) != 0


def _find_free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
