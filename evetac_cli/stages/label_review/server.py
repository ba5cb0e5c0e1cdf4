"""Serves the page of a review: the data of each recording, and the verdicts that the page sends.

page_server.py decides who has access. Requests that write come by POST, as JSON, from the page itself (Origin).
"""

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tornado import web

from evetac_cli import console
from evetac_cli.commands.label import Label
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.page_server import Guarded, OwnServer
from evetac_cli.stages.label_review.person import Verdict, keep, name_of
from evetac_cli.stages.label_review.trial_data import trial_data
from evetac_cli.store.recordings.read import open_recording

HERE = Path(__file__).parent
CONTENT: dict[str, tuple[Path, str]] = {
    "": (HERE / "page.html", "text/html"),
    "page.js": (HERE / "page.js", "text/javascript"),
    "page.css": (HERE / "page.css", "text/css"),
}
LAST_S = 0.2  # for the last answer to arrive


class ReviewServer(OwnServer):
    """The page at `url`; `done` is set when the person has finished, `rows` has a row for each kept label."""

    def __init__(self, recordings: Sequence[Path], labels: Sequence[Path], params: Label) -> None:
        """Start to listen."""
        self.recordings, self.labels, self.params = recordings, labels, params
        self.by = name_of(params.by)
        self.done = asyncio.Event()
        self.rows: Rows = []
        super().__init__(CONTENT, [(rf"/([^/]*)/{name}", handler, {}) for name, handler in HANDLERS.items()])

    def kept(self, row: dict[str, Any]) -> None:
        """Record a kept verdict; it replaces an earlier one for the same recording."""
        self.rows = [one for one in self.rows if one["output"] != row["output"]] + [row]
        console.say(f"kept {row['output']}: onset {row['onset_ms']} ms, by {row['by']}")

    async def end(self) -> None:
        """Stop answering requests."""
        self.door.stop()
        await asyncio.sleep(LAST_S)
        await self.door.close_all_connections()


class _Asked(Guarded):
    """A request about a recording, by its number."""

    _page_server: ReviewServer

    def place(self, number: Any) -> int:
        """Return the number of a recording; HTTP 404 if there is none."""
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(self.server.recordings):
            raise web.HTTPError(404)
        return number

    @property
    def server(self) -> ReviewServer:
        """The server."""
        return self._page_server

    def say(self, answer: dict[str, Any]) -> None:
        """Answer with JSON."""
        self.set_header("Content-Type", "application/json; charset=utf-8")
        self.finish(json.dumps(answer, allow_nan=False))


class _Trial(_Asked):
    """The data for the page."""

    def get(self, token: str) -> None:
        """Answer `trial?n=NUMBER&at=SLICE` with the data around a slice, or around the onset."""
        number = self.place(_whole(self.get_query_argument("n", "0")))
        at_text = self.get_query_argument("at", "")
        at = _whole(at_text) if at_text else None
        try:
            with open_recording(self.server.recordings[number]) as recording:
                data = trial_data(recording, self.server.labels[number], at)
        except EvetacError as error:
            data = {"error": str(error), "name": self.server.recordings[number].name}
        self.say({**data, "n": number, "of": len(self.server.recordings), "by": self.server.by})


class _Post(_Asked):
    """A request that changes something."""

    def body(self) -> dict[str, Any]:
        """Return the request's JSON object; HTTP 403 or 400 unless it is one from the page."""
        if not self.is_from_here():
            raise web.HTTPError(403)
        if self.request.headers.get("Content-Type", "").partition(";")[0] != "application/json":
            raise web.HTTPError(400)
        try:
            sent = json.loads(self.request.body)
        except ValueError:
            raise web.HTTPError(400) from None
        if not isinstance(sent, dict):
            raise web.HTTPError(400)
        return sent


class _Keep(_Post):
    """Keeps a verdict."""

    def post(self, token: str) -> None:
        """Answer `keep` {n, onset, earliest, latest, can_tell} with the kept row, or the error."""
        sent = self.body()
        number = self.place(sent.get("n"))
        onset, earliest, latest = (sent.get(name, -1) for name in ("onset", "earliest", "latest"))
        can_tell = sent.get("can_tell", True)
        if (
            not all(type(value) is int and -1 <= value < 2**53 for value in (onset, earliest, latest))
            or type(can_tell) is not bool
        ):
            raise web.HTTPError(400)
        server = self.server
        try:
            with open_recording(server.recordings[number]) as recording:
                verdict = Verdict(onset, earliest, latest, can_tell)
                row = keep(recording, server.labels[number], verdict, server.by, server.params.after_ms)
        except EvetacError as error:
            self.say({"error": str(error)})
            return
        server.kept(row)
        self.say({"row": row})


class _Done(_Post):
    """Ends the review."""

    def post(self, token: str) -> None:
        """Answer `done` {} with the number of kept labels."""
        self.body()
        self.say({"kept": len(self.server.rows)})
        self.server.done.set()


HANDLERS: dict[str, type[_Asked]] = {"trial": _Trial, "keep": _Keep, "done": _Done}


def _whole(text: str) -> int:
    """Return a whole number of at most 15 digits; HTTP 400 for anything else."""
    if not text.isascii() or not text.isdigit() or len(text) > 15:
        raise web.HTTPError(400)
    return int(text)
