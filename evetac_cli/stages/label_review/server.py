"""Serves the page of a review: the data of each recording, and the verdicts that the page sends.

local_server.py controls access. Requests are answered one after the other, in the thread that waits for the person.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from http import HTTPStatus
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from evetac_cli import console
from evetac_cli.commands.label import Label
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.realtime.local_server import PageServer, RequestRefused
from evetac_cli.stages.label_review.person import Verdict, keep, name_of
from evetac_cli.stages.label_review.trial_data import trial_data
from evetac_cli.store.recordings.read import open_recording

HERE = Path(__file__).parent
FILES = (HERE / "page.html", HERE / "page.js", HERE / "page.css")
Answer = Callable[[dict[str, Any]], dict[str, Any]]


class ReviewServer(PageServer):
    """The page at `url`; `rows` has a row for each kept label."""

    def __init__(self, recordings: Sequence[Path], labels: Sequence[Path], params: Label) -> None:
        """Begin to listen."""
        self.recordings, self.labels, self.params = recordings, labels, params
        self.by = name_of(params.by)
        self.rows: Rows = []
        self._is_done = False
        self._asked: SimpleQueue[tuple[Answer, dict[str, Any], Future[dict[str, Any]]]] = SimpleQueue()
        answers = {("GET", "trial"): self._trial, ("POST", "keep"): self._keep, ("POST", "done"): self._done}
        super().__init__(FILES, {place: self._in_turn(answer) for place, answer in answers.items()})

    def _in_turn(self, answer: Answer) -> Answer:
        def ask(sent: dict[str, Any]) -> dict[str, Any]:
            answered: Future[dict[str, Any]] = Future()
            self._asked.put((answer, sent, answered))
            return answered.result()

        return ask

    def run(self) -> None:
        """Answer requests until the person is done."""
        while not self._is_done:
            answer, sent, answered = self._asked.get()
            try:
                answered.set_result(answer(sent))
            except Exception as error:
                answered.set_exception(error)

    def _trial(self, sent: dict[str, Any]) -> dict[str, Any]:
        """Answer `trial?n=NUMBER&at=SLICE` with the data around a slice, or around the onset."""
        number = self._number(_whole(sent.get("n", "0")))
        at = _whole(sent["at"]) if "at" in sent else None
        try:
            with open_recording(self.recordings[number]) as recording:
                data = trial_data(recording, self.labels[number], at)
        except EvetacError as error:
            data = {"error": str(error), "name": self.recordings[number].name}
        return {**data, "n": number, "of": len(self.recordings), "by": self.by}

    def _keep(self, sent: dict[str, Any]) -> dict[str, Any]:
        """Answer `keep` {n, onset, earliest, latest, can_tell} with the kept row, or the error."""
        number = self._number(sent.get("n"))
        onset, earliest, latest = slices = [sent.get(name, -1) for name in ("onset", "earliest", "latest")]
        can_tell = sent.get("can_tell", True)
        if not all(type(value) is int and -1 <= value < 2**53 for value in slices) or type(can_tell) is not bool:
            raise RequestRefused(HTTPStatus.BAD_REQUEST)
        verdict = Verdict(onset, earliest, latest, can_tell)
        try:
            with open_recording(self.recordings[number]) as recording:
                row = keep(recording, self.labels[number], verdict, self.by, self.params.after_ms)
        except EvetacError as error:
            return {"error": str(error)}
        self.rows = [one for one in self.rows if one["output"] != row["output"]] + [row]
        console.say(f"kept {row['output']}: onset {row['onset_ms']} ms, by {row['by']}")
        return {"row": row}

    def _done(self, sent: dict[str, Any]) -> dict[str, Any]:
        """Answer `done` {} with the number of kept labels, and end the review."""
        self._is_done = True
        return {"kept": len(self.rows)}

    def _number(self, number: Any) -> int:
        """Return the number of a recording."""
        if type(number) is not int or not 0 <= number < len(self.recordings):
            raise RequestRefused(HTTPStatus.NOT_FOUND)
        return number


def _whole(text: str) -> int:
    """Return a whole number of at most 15 digits."""
    if not text.isascii() or not text.isdigit() or len(text) > 15:
        raise RequestRefused(HTTPStatus.BAD_REQUEST)
    return int(text)
