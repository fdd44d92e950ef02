# SPDX-License-Identifier: Apache-2.0
"""Notes to the supervisor systemd: that the agent is ready, still works, and stops (protocol of sd_notify). Elsewhere, nothing."""

from __future__ import annotations

import contextlib
import os
import socket

SOCKET_VARIABLE = "NOTIFY_SOCKET"


class Supervisor:
    """Sends notes to the socket that systemd names in the environment; a note that cannot be sent is left out."""

    def __init__(self) -> None:
        address = os.environ.get(SOCKET_VARIABLE, "")
        # A name that begins with @ is abstract.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        self._is_ready = False

    def tick(self) -> None:
        """Note a frame: the first one makes the service ready, each one feeds its watchdog."""
        self._send("WATCHDOG=1" if self._is_ready else "READY=1\nWATCHDOG=1")
        self._is_ready = True

    def stop(self) -> None:
        """Note that the agent stops."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), self._address)
