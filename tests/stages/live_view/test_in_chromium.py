"""The page of a live view in a real browser: headless Chromium, driven over its debugging protocol."""

import asyncio
import base64
import contextlib
import itertools
import json
import os
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.stages.live_view.test_live_view import shown

pytest.importorskip("tornado")
from tornado.websocket import WebSocketClientConnection, websocket_connect

CHROMIUM = shutil.which("chromium")
WIDTHS = (420, 860, 1280, 2560)
PATIENCE_S = 60.0
PICTURES = os.environ.get("EVETAC_PICTURES")  # a folder: what was seen is kept there

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")]


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[str]:
    """The address at which a page of a headless browser is driven."""
    assert CHROMIUM is not None
    words = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--remote-debugging-port=0",
        f"--user-data-dir={folder}",
    ]
    with subprocess.Popen([CHROMIUM, *words, "about:blank"], stderr=subprocess.PIPE, text=True) as run:
        try:
            for line in run.stderr or ():
                if address := re.search(r"listening on ws://([^/]+)/", line):
                    break
            else:
                raise AssertionError("chromium did not start")
            with urllib.request.urlopen(f"http://{address.group(1)}/json/list") as answer:
                pages = [page for page in json.load(answer) if page["type"] == "page"]
            yield pages[0]["webSocketDebuggerUrl"]
        finally:
            run.kill()


class Page:
    """A page that is driven, and what it complained of."""

    def __init__(self, socket: WebSocketClientConnection) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []

    async def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            text = await asyncio.wait_for(self._socket.read_message(), PATIENCE_S)
            assert text is not None
            message = json.loads(text)
            if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled"):
                self.complaints.append(json.dumps(message["params"]))
            if message.get("id") == number:
                assert "error" not in message, message
                return dict(message["result"])

    async def value(self, script: str) -> Any:
        """What an expression is on the page."""
        result = await self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def close(self) -> None:
        self._socket.close()

    async def until(self, script: str) -> None:
        """Wait until an expression is true."""
        end_s = time.monotonic() + PATIENCE_S
        while not await self.value(script):
            assert time.monotonic() < end_s, (script, self.complaints, await self.value("document.body.innerText"))
            await asyncio.sleep(0.1)

    async def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            text = {"text": key} if len(key) == 1 and kind == "keyDown" else {}
            await self.ask("Input.dispatchKeyEvent", type=kind, key=key, **text)

    async def click(self, name: str) -> None:
        """With the mouse, in the middle of the element of this id."""
        script = "(() => { const element = document.getElementById('NAME'); element.scrollIntoView();"
        script += " const b = element.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        x, y = await self.value(script.replace("NAME", name))
        for kind in ("mousePressed", "mouseReleased"):
            await self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    async def keep(self, name: str) -> None:
        """A picture of the whole page, where it is asked for."""
        if PICTURES:
            shot = await self.ask("Page.captureScreenshot", captureBeyondViewport=True)
            (Path(PICTURES) / f"{name}.png").write_bytes(base64.b64decode(shot["data"]))


async def complaints(debugger: str, address: str, end_by: str) -> list[str]:
    """What a browser complains of while somebody uses the page, and ends by the button or its key."""
    page = Page(await websocket_connect(debugger, max_message_size=1 << 26))
    try:
        await use(page, address, end_by)
    finally:
        page.close()
    return page.complaints


async def use(page: Page, address: str, end_by: str) -> None:
    """See the page at all widths, use its keys and buttons, and let go."""
    for part in ("Runtime", "Log", "Page"):
        await page.ask(f"{part}.enable")
    size = {"height": 900, "deviceScaleFactor": 1, "mobile": False}
    await page.ask("Emulation.setDeviceMetricsOverride", width=1280, **size)
    await page.ask("Page.navigate", url=address)
    await page.until("document.getElementById('state')?.textContent === 'live'")
    await page.until("document.querySelectorAll('.chart:not([hidden])').length >= 5")
    for width in WIDTHS:
        await page.ask("Emulation.setDeviceMetricsOverride", width=width, **size)
        await asyncio.sleep(1.0)
        assert await page.value("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), width
        await page.keep(f"live-{width}")
    await page.ask("Emulation.setDeviceMetricsOverride", width=1280, **size)
    hold = "document.getElementById('pause').getAttribute('aria-pressed')"
    await page.press(" ")
    assert await page.value(hold) == "true"
    await page.click("pause")
    assert await page.value(hold) == "false"
    await page.press("d")
    assert not await page.value("document.getElementById('dots').checked")
    await page.press("a")
    assert await page.value("document.getElementById('arrows').value") == "20"
    number = "Number(document.querySelector('#tiles dd').textContent.split(' ')[0])"
    before = await page.value(number)
    await page.until(f"{number} > {before}")
    await (page.click("let-go") if end_by == "mouse" else page.press("Escape"))
    await page.until("document.getElementById('state').textContent.startsWith('ended')")
    assert "let go by the button" in await page.value("document.getElementById('state').textContent")
    await page.keep("live-ended")


@pytest.mark.parametrize("end_by", ["mouse", "key"])
def test_the_page_works_in_a_browser(end_by: str, tmp_path: Path) -> None:
    """Assert that nothing is complained of, nothing is wider than the window, and keys and mouse do what they say."""
    more = ["--gripper", "virtual", "--hold-s", "100", "--expected-event-rate", "1e5", "--watchdog-ms", "500"]
    with browser(tmp_path / "profile") as debugger, shown(tmp_path, "record", *more) as live:
        said_by_browser = asyncio.run(complaints(debugger, f"http://{live.address}", end_by))
        code, said = live.end()
    assert said_by_browser == []
    assert code == 130, said
