"""A headless Chromium for tests of pages, if one is installed."""

import json
import os
import select
import subprocess
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

from tests.patience import PATIENCE_S


class Browser:
    """A headless Chromium, controlled through a pipe (Chrome DevTools Protocol)."""

    def __init__(self, program: str, folder: Path) -> None:
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        flags = (
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--remote-debugging-pipe",
            f"--user-data-dir={folder}",
        )
        hand_over = f'exec "$0" "$@" 3<&{theirs_in} 4>&{theirs_out}'  # the protocol requires these two numbers
        self._process = subprocess.Popen(
            ["bash", "-c", hand_over, program, *flags, "about:blank"],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._buffer = b""
        self._calls = 0
        self._session: dict[str, str] = {}
        self.events: list[dict[str, Any]] = []
        (page,) = [one for one in self.call("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        attached = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=1300, height=1200, deviceScaleFactor=1, mobile=False)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._calls += 1
        message = {"id": self._calls, "method": method, "params": params, **self._session}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._calls:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self.events.append(answer)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], PATIENCE_S)[0], "the browser does not answer"
            piece = os.read(self._from, 1 << 20)
            assert piece, "the browser has ended"
            self._buffer += piece
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))

    def run(self, code: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, code: str) -> Any:
        """Wait until an expression is true."""
        ends = time.monotonic() + PATIENCE_S
        while not (value := self.run(code)):
            assert time.monotonic() < ends, (code, self.complaints())
            time.sleep(0.02)
        return value

    def visit(self, address: str) -> None:
        """Start to load a page."""
        self.events.clear()
        self.call("Page.navigate", url=address)

    def open(self, page: Path, drawn: str = "true") -> None:
        """Load a page and wait until its charts are drawn, and an expression is true."""
        self.visit(page.resolve().as_uri())
        self.until(
            "document.readyState === 'complete'"
            f" && decodeURIComponent(location.pathname) === {json.dumps(str(page.resolve()))}"
            f" && (document.documentElement.dataset.charts || !window.Bokeh) && ({drawn})"
        )

    def resize(self, width: int) -> None:
        """Set the width of the window."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=1200, deviceScaleFactor=1, mobile=False)
        self.until(f"innerWidth === {width}")

    def picture(self, path: Path) -> None:
        """Save the visible page as PNG."""
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def key(self, key: str, **more: Any) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, **more)

    def mouse(self, x: float, y: float, *kinds: str) -> None:
        for kind in kinds:
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def complaints(self, server: str = "file:") -> list[Any]:
        """Return console errors and warnings, exceptions, and requests to other servers than the page's own."""
        events = []
        for event in self.events:
            params = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown" | "Log.entryAdded":
                    events.append(params)
                case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning", "assert"):
                    events.append(params)
                case "Network.requestWillBeSent" if not params["request"]["url"].startswith(
                    (server, "file:", "data:", "blob:")
                ):
                    events.append(params)
        return events

    def close(self) -> None:
        self.call("Browser.close")
        self._process.wait(PATIENCE_S)
        os.close(self._to)
        os.close(self._from)
