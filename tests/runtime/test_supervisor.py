# SPDX-License-Identifier: Apache-2.0
"""Notes to systemd are those of sd_notify(3): READY=1 once, WATCHDOG=1 a frame, STOPPING=1."""

import socket

from manyeyes.runtime.supervisor import SOCKET_VARIABLE, Supervisor


def test_a_service_is_ready_with_its_first_frame_and_feeds_its_watchdog(tmp_path, monkeypatch) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(path)
        systemd.settimeout(10.0)
        monkeypatch.setenv(SOCKET_VARIABLE, path)
        supervisor = Supervisor()
        supervisor.tick()
        supervisor.tick()
        supervisor.stop()
        supervisor.tick()
        notes = [systemd.recv(100).decode() for _ in range(3)]
    assert notes == ["READY=1\nWATCHDOG=1", "WATCHDOG=1", "STOPPING=1"]


def test_without_systemd_nothing_is_sent(monkeypatch) -> None:
    monkeypatch.delenv(SOCKET_VARIABLE, raising=False)
    opened: list[object] = []
    monkeypatch.setattr(socket, "socket", lambda *arguments: opened.append(arguments))
    supervisor = Supervisor()
    supervisor.tick()
    supervisor.stop()
    assert not opened
