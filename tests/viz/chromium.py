# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium over the DevTools protocol: opens a page, evaluates expressions in it, moves the mouse, photographs it."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import time
from typing import Any

import numpy as np
from PIL import Image

FLAGS = (
    "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --hide-scrollbars --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)


def find_program() -> str | None:
    """Return the browser's program, None where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((found for name in names if (found := shutil.which(name))), None)


class Browser:
    """A browser process; ``open`` selects the page that all other calls mean."""

    def __init__(self, program: str, profile: str) -> None:
        to_read, self.to = os.pipe()
        self.back, from_write = os.pipe()
        command = f'exec "$0" {FLAGS} --window-size=1000,700 --user-data-dir="$1" --remote-debugging-pipe '
        command += f"about:blank 3<&{to_read} 4>&{from_write}"
        self.process = subprocess.Popen(
            ["bash", "-c", command, program, profile],
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(from_write)
        self.held, self.count, self.session = b"", 0, None

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        self.count += 1
        message = {"id": self.count, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.held:
                more = os.read(self.back, 1 << 16)
                assert more, "Chromium ended"
                self.held += more
            text, self.held = self.held.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("id") == self.count:
                assert "result" in answer, answer
                return answer["result"]

    def open(self, url: str, ready: str = "document.body && document.body.dataset.ready") -> None:
        """Open a page in a tab of its own, and wait for an expression; by default for ``data-ready`` of the body."""
        self.session = None
        target = self.ask("Target.createTarget", url=url)["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        end = time.monotonic() + 60
        while self.value(ready) in (None, False):
            assert time.monotonic() < end, "the page was never drawn"
            time.sleep(0.1)

    def resize(self, width: int, height: int, is_dark: bool = False) -> None:
        """Set the size of the page in CSS pixels, and its colour scheme."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])
        time.sleep(0.3)

    def value(self, expression: str) -> Any:
        """Return the value of an expression; an exception in the page fails."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, **params: Any) -> None:
        """Send a mouse event: mouseMoved, mousePressed or mouseReleased, at a place of the window."""
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **params)

    def photograph(self, whole: bool = False) -> np.ndarray:
        """Return the window, or the whole page, as (H, W, 3) integers."""
        shot = base64.b64decode(self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"])
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20)
        os.close(self.to)
        os.close(self.back)
