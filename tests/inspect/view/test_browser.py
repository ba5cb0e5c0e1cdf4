"""The page in a headless Chromium, where one is installed."""

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.inspect import view
from evetac_cli.params.inspection import View
from tests.inspect.view.trials import NASTY, ONSET, SLICES, moving, write_recording, write_tracks


class Browser:
    """A headless Chromium, told what to do through a pipe (Chrome DevTools Protocol)."""

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
        hand_over = f'exec "$0" "$@" 3<&{theirs_in} 4>&{theirs_out}'  # the protocol wants these two numbers
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
            assert select.select([self._from], [], [], 60)[0], "the browser does not answer"
            piece = os.read(self._from, 1 << 20)
            assert piece, "the browser has ended"
            self._buffer += piece
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))

    def run(self, code: str) -> Any:
        """The value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, code: str) -> Any:
        """Wait until an expression is true."""
        ends = time.monotonic() + 60
        while not (value := self.run(code)):
            assert time.monotonic() < ends, (code, self.complaints())
            time.sleep(0.02)
        return value

    def open(self, page: Path) -> None:
        """Load a page and wait until all of it is drawn."""
        self.events.clear()
        self.call("Page.navigate", url=page.resolve().as_uri())
        self.until(
            "document.readyState === 'complete' && location.protocol === 'file:'"
            " && (document.documentElement.dataset.charts || !document.querySelector('.chart'))"
            " && (document.getElementById('viewer').hidden || document.getElementById('image').dataset.index)"
        )

    def key(self, key: str, **more: Any) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, **more)

    def mouse(self, x: float, y: float, *kinds: str) -> None:
        for kind in kinds:
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def complaints(self) -> list[Any]:
        """Errors and warnings on the console, exceptions, and requests to anywhere."""
        events = []
        for event in self.events:
            params = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown" | "Log.entryAdded":
                    events.append(params)
                case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning", "assert"):
                    events.append(params)
                case "Network.requestWillBeSent" if not params["request"]["url"].startswith(
                    ("file:", "data:", "blob:")
                ):
                    events.append(params)
        return events

    def close(self) -> None:
        self.call("Browser.close")
        self._process.wait(30)
        os.close(self._to)
        os.close(self._from)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The Chromium of this machine."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
    if program is None:
        pytest.skip("no Chromium is installed here: the page is not tried in a browser")
    chromium = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield chromium
    chromium.close()


INDEX = "Number(document.getElementById('image').dataset.index)"
PIXELS = "document.getElementById('image').toDataURL()"
COLOURS = """(() => { const c = document.getElementById('image');
  const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);
  return new Set(d).size; })()"""


def test_page_in_a_browser(browser: Browser, page: Path) -> None:
    """Assert that the page draws without a complaint, and that slider, keys, pointer, click and play move the image."""
    browser.open(page)
    assert browser.run("document.querySelectorAll('.chart').length") == 7
    assert browser.run("Bokeh.documents[0].roots().length") == 7
    assert browser.run(COLOURS) > 3
    assert browser.run(INDEX) == ONSET  # it opens on the first onset
    before = browser.run(PIXELS)
    browser.run(
        "(() => { const s = document.getElementById('scrub'); s.value = 3; s.dispatchEvent(new Event('input')); })()"
    )
    browser.until(f"{INDEX} === 3")
    assert browser.run(PIXELS) != before
    for key, more, index in (
        ("ArrowRight", {}, 4),
        ("ArrowRight", {"modifiers": 8}, 14),
        ("ArrowLeft", {}, 13),
        ("End", {}, SLICES - 5),
        ("Home", {}, 0),
    ):
        browser.key(key, **more)
        browser.until(f"{INDEX} === {index}")
    assert browser.run("document.getElementById('time').textContent") == "0.000 s"
    left, width, top = browser.run(
        "(({left, width, top}) => [left, width, top])"
        "(document.querySelector('.chart .bk-Figure').getBoundingClientRect())"
    )
    at = left + 58 + (width - 58 - 14) / 2, top + 50
    browser.mouse(*at, "mouseMoved")
    browser.until(f"Math.abs({INDEX} - {SLICES // 2}) <= 8")  # it follows the pointer
    browser.run("document.getElementById('follow').click()")
    browser.key("Home")
    browser.until(f"{INDEX} === 0")
    browser.mouse(*at, "mouseMoved", "mousePressed", "mouseReleased")
    browser.until(f"Math.abs({INDEX} - {SLICES // 2}) <= 8")
    cursors = browser.run("Bokeh.documents[0].roots().map((f) => f.center.find((p) => p.name === 'cursor').location)")
    assert cursors == [browser.run(f"{INDEX} / 1000")] * 7
    browser.run("document.querySelectorAll('.jump')[1].click()")
    browser.until(f"{INDEX} === {ONSET + 3}")
    dotted = browser.run(PIXELS)
    browser.run("document.getElementById('dots').click()")
    browser.until(f"{PIXELS} !== {json.dumps(dotted)}")
    browser.run("document.activeElement.blur()")
    browser.key(" ")
    browser.until(f"{INDEX} > {ONSET + 5}")
    browser.key(" ")
    assert browser.run("document.getElementById('play').textContent") == "Play"
    assert browser.complaints() == []


def test_hostile_pages_in_a_browser(browser: Browser, tmp_path: Path) -> None:
    """Assert that an empty recording, one slice, markup in names, tracks alone and NaN make no complaint."""
    for name, slices in (("empty", 0), ("one", 1), ("a\"'<b>&ü", 30)):
        header = write_recording(tmp_path / f"{name}.recording.h5", slices, scene=NASTY)
        dots = moving(slices)
        dots[1::2] = np.nan
        write_tracks(tmp_path / f"{name}.tracks.h5", header, dots)
        view.run([tmp_path / f"{name}.recording.h5"], View(), None)
        browser.open(tmp_path / f"{name}.html")
        assert browser.run("document.querySelector('h1').textContent") == f"{name}.recording.h5"
        assert browser.run("document.title") == f"{name}.recording.h5 - evetac view"
        assert browser.run("document.querySelectorAll('.chart').length > 0") == (slices > 0)
        assert browser.run("document.getElementById('viewer').hidden") == (slices == 0)
        assert browser.complaints() == []
    (tmp_path / "one.recording.h5").unlink()
    view.run([tmp_path / "one.tracks.h5"], View(), tmp_path / "tracks.html")
    browser.open(tmp_path / "tracks.html")
    assert browser.run("document.getElementById('count').textContent") == "no event images"
    assert browser.complaints() == []
