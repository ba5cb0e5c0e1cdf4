"""The process of a live view: serves a page or draws on the terminal, with lower priority than all recording processes.

It has the highest possible niceness, so that a busy computer loses pictures first. It ends with the process that
started it, and its failure never affects the recording.
"""

import contextlib
import time
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Any

from evetac_cli import console
from evetac_cli.interrupts import ignore_interrupts
from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.realtime.processes import set_niceness
from evetac_cli.trials.live_view import terminal
from evetac_cli.trials.live_view.messages import (
    BROWSER,
    Begun,
    Ended,
    Lost,
    Said,
    Title,
)
from evetac_cli.trials.live_view.samples import PERIOD_S, Follower, OpenDetector, load
from evetac_cli.trials.live_view.shared_view import SharedView

NICENESS = 19
TERMINAL_PERIOD_S = 0.1
MOST_SAID = 20


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
                case Begun():
                    self.follower.begin(message.sensor, self._open_detector)
                    self.version += 1
                case Lost():
                    self.lost = message
                case Said():
                    self.messages = [*self.messages, message.text][-MOST_SAID:]
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
                "said": self.messages,
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
    where: str, title: Title, shared: SharedView, open_detector: OpenDetector, pipe: Connection, ready: Connection
) -> None:
    """Run the process: `where` is BROWSER or TERMINAL.

    `ready` receives the page's address, and the one that works once, or "", once it can be viewed.
    """
    ignore_interrupts()
    load(open_detector)  # nothing is being recorded yet
    set_niceness(NICENESS)
    state = ViewState(title, Follower(shared), MessageReader(pipe), open_detector)
    with contextlib.suppress(BrokenPipeError):  # the recording process has gone and can receive nothing
        if where == BROWSER:
            _serve(state, shared, ready)
        else:
            ready.send(("", ""))
            _draw(state)


def _serve(state: ViewState, shared: SharedView, ready: Connection) -> None:
    from evetac_cli.trials.live_view.server import PictureServer

    server = PictureServer(shared.let_go if state.title.moves else lambda: None)
    ready.send((server.url, server.url_once))
    for began_s, sample in _samples(state):
        if server.is_asked:
            news = {**state.news(sample), "let_go": shared.is_asked_to_let_go}
            server.send(news, state.follower.image(), state.description, state.version)
        time.sleep(_left_s(began_s, PERIOD_S))
    server.end(state.ended)


def _draw(state: ViewState) -> None:
    with console.live() as show:
        for began_s, sample in _samples(state):
            show(terminal.screen(state.follower, sample, state.lost.events, state.messages))
            time.sleep(_left_s(began_s, TERMINAL_PERIOD_S))


def _samples(state: ViewState) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield a sample, and when (s) it was begun, until the recording ends."""
    while True:
        began_s = time.monotonic()
        state.listen()
        if state.ended:
            return
        yield began_s, state.follower.sample()


def _left_s(began_s: float, period_s: float) -> float:
    """Return the time until the next sample, in s; a late sample does not make the next one earlier."""
    return max(began_s + period_s - time.monotonic(), 1e-3)
