"""The process of a live view: serves its page, with lower priority than all recording processes.

It has the highest possible niceness, so that a busy computer loses pictures first. It ends with the process that
started it, and its failure never affects the recording.
"""

import contextlib
import json
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from evetac_cli.interrupts import ignore_interrupts
from evetac_cli.realtime.local_server import PageServer
from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.realtime.processes import set_niceness
from evetac_cli.resources import DATA
from evetac_cli.trials.live_view.samples import PERIOD_S, Follower, OpenDetector, load
from evetac_cli.trials.live_view.shared_view import Ended, Lost, Message, SharedView, Started, Title

NICENESS = 19
MOST_MESSAGES = 20
HERE = Path(__file__).parent
FILES = (HERE / "page.html", HERE / "page.js", HERE / "page.css", DATA / "touch_map.js")
LAST_S = 0.5  # time for clients that draw a picture to request the last message


class ViewState:
    """The state of a view besides the slices, from the messages of the recording process."""

    def __init__(self, title: Title, follower: Follower, inbox: MessageReader, open_detector: OpenDetector) -> None:
        self.title, self.follower = title, follower
        self._inbox, self._open_detector = inbox, open_detector
        self.version = 0  # version of `description`
        self.lost = Lost("0", "")
        self.messages: list[str] = []
        self.ended = ""

    def listen(self) -> None:
        """Take the messages that have arrived."""
        for message in self._inbox.take():
            match message:
                case Started():
                    self.follower.begin(message.sensor, self._open_detector)
                    self.version += 1
                case Lost():
                    self.lost = message
                case Message():
                    self.messages = [*self.messages, message.text][-MOST_MESSAGES:]
                    self.version += 1
                case Ended():
                    self.ended = message.why
        if self._inbox.ended and not self.ended:
            self.ended = "the recording program has ended"

    def description(self) -> dict[str, Any]:
        """Return the data that a page needs before its first picture."""
        follower = self.follower
        return {
            "about": {
                **self.title._asdict(),
                "frame_px": follower.frame_px,
                "threshold": follower.threshold,
                "notes": follower.notes,
                "messages": self.messages,
                "samples": list(follower.samples),
            }
        }

    def news(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return the data that a page gets with every picture."""
        follower = self.follower
        return {
            "sample": sample,
            "dots": follower.dots(),
            "touch": follower.touch_map(),
            "window_px": follower.window_px,
            "lost": self.lost.events,
            "lost_why": self.lost.why,
            "left_out": follower.left_out,
            "ended": self.ended,
        }


def run_view(
    title: Title, shared: SharedView, open_detector: OpenDetector, pipe: Connection, ready: Connection
) -> None:
    """Run the process; `ready` receives the page's address, and the one that works once, when it can be viewed."""
    ignore_interrupts()
    load(open_detector)  # nothing is being recorded yet
    set_niceness(NICENESS)
    state = ViewState(title, Follower(shared), MessageReader(pipe), open_detector)
    with contextlib.suppress(BrokenPipeError):  # the recording process has gone and can receive nothing
        _serve(state, shared, ready)


def _serve(state: ViewState, shared: SharedView, ready: Connection) -> None:
    server = PictureServer(shared.let_go if state.title.moves else lambda: None)
    ready.send((server.url, server.url_once))
    while True:
        began_s = time.monotonic()
        state.listen()
        if state.ended:
            break
        sample = state.follower.sample()
        if server.is_asked:
            news = {**state.news(sample), "let_go": shared.is_asked_to_let_go}
            server.send(news, state.follower.image(), state.description, state.version)
        time.sleep(max(began_s + PERIOD_S - time.monotonic(), 1e-3))  # a late sample makes the next no earlier
    server.end(state.ended)


class PictureServer(PageServer):
    """The page at `url` and its clients.

    A client gets a picture only after it has drawn the previous one and requests the next. So a slow browser, or a
    hidden tab, gets fewer pictures, and nothing piles up. The page loads nothing else; local_server.py controls access.
    """

    def __init__(self, let_go: Callable[[], None]) -> None:
        """Begin to listen; let_go: called when the user presses the button."""

        def pressed(sent: dict[str, Any]) -> dict[str, Any]:
            let_go()
            return {}

        self._lock = threading.Lock()
        self._waiting: list[tuple[str, Future[bytes]]] = []  # the version that a client knows, and its answer
        self._ended = b""
        super().__init__(FILES, {("GET", "pictures"): self._picture, ("POST", "let-go"): pressed})

    def _picture(self, sent: dict[str, Any]) -> bytes:
        """Return the next picture; sent: the version of the description that the client knows."""
        picture: Future[bytes] = Future()
        with self._lock:
            if self._ended:
                return self._ended
            self._waiting.append((sent.get("known", ""), picture))
        return picture.result()

    @property
    def is_asked(self) -> bool:
        """Whether a client waits for a picture."""
        return bool(self._waiting)

    def send(
        self, news: Mapping[str, Any], image: bytes, description: Callable[[], Mapping[str, Any]], version: int
    ) -> None:
        """Send a picture to every client that waits for one.

        image: one byte per pixel; description: data that a client needs before its first picture, and again when its
        version changes.
        """
        with self._lock:
            waiting, self._waiting = self._waiting, []
        for known, picture in waiting:
            more = {} if known == str(version) else description()
            picture.set_result(_message({**news, **more, "version": version}, image))

    def end(self, why: str) -> None:
        """Send every client the reason for the end, and close."""
        with self._lock:
            self._ended = _message({"ended": why}, b"")
        for _, picture in self._waiting:
            picture.set_result(self._ended)
        time.sleep(LAST_S)
        self.close()


def _message(news: Mapping[str, Any], image: bytes) -> bytes:
    """Return the news as JSON, preceded by its length and followed by the picture."""
    text = json.dumps(news, allow_nan=False, separators=(",", ":")).encode()
    return len(text).to_bytes(4, "little") + text + image
