"""Serves the page of a review: the data of each recording around a slice, and the verdicts that the page sends.

local_server.py controls access. Requests are answered one after the other, in the thread that waits for the person.
"""

from base64 import b64encode
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from http import HTTPStatus
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli import console
from evetac_cli.commands.label import Label
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.jobs import Rows
from evetac_cli.kernels.labelling.flow import Labels
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.realtime.local_server import PageServer, RequestRefused
from evetac_cli.stages.label_methods import compute
from evetac_cli.stages.label_review.person import Verdict, keep, name_of
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.onset import LabelledOnset, labelled_onset, onset_of_values
from evetac_cli.store.recordings.read import Recording, open_recording, ramp_start

HERE = Path(__file__).parent
FILES = (HERE / "page.html", HERE / "page.js", HERE / "page.css")
BEFORE_MS, AFTER_MS = 250, 150  # time shown before and after the chosen slice
SHORTEST_MS = 40  # shown at least on either side, with any number of events
MOST_EVENTS = 400_000  # in an answer: 2 MB
MOST_BINS = 1200  # of the overview
TRACKED_MS = 2000  # tracking starts this long before the shown time, or at the start of the recording
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


def onset_now(recording: Recording, labels: Path, computed: Labels | None) -> tuple[LabelledOnset, dict[str, Any]]:
    """Return the current onset and its origin: from the labels file, or without one from those of `event-flow`."""
    if labels.exists():
        with StageFile(labels, "labels") as file:
            check_made_from(file, recording)
            parameters = file.header["parameters"]
            about = {
                "method": parameters.get("method"),
                "by": parameters.get("by"),
                "at": file.header["made"].get("at"),
            }
            return labelled_onset(file), {**about, "kept": True}
    if computed is None:
        return LabelledOnset(None, None, None, None, ""), {"method": None, "kept": False}
    onset = onset_of_values(computed.onset, computed.earliest, computed.latest, computed.confidence, computed.doubt)
    return onset, {"method": "event-flow", "kept": False}


def by_flow(recording: Recording) -> Labels | None:
    """Return labels by `event-flow`; None if the recording lacks required data."""
    try:
        return compute(recording, Label())
    except InputError:
        return None


def trial_data(recording: Recording, labels: Path, at: int | None) -> dict[str, Any]:
    """Return everything that the page draws around slice `at`, or around the onset, as plain texts and numbers."""
    slices, start = len(recording), ramp_start(recording)
    flow = by_flow(recording)
    onset, about = onset_now(recording, labels, flow)
    middle = at if at is not None else onset.slice_ if onset.slice_ is not None else (start + slices) // 2
    first, stop = _span(recording.starts, min(max(middle, 0), max(slices - 1, 0)))
    events = recording.between(first, stop)
    window = recording.window_px
    counts = _window_counts(recording, first, stop)
    data: dict[str, Any] = {
        "name": recording.path.name,
        "simulated": bool(recording.header["simulated"]),
        "slices": slices,
        "start": start,
        "span": [first, stop],
        "frame": list(recording.frame_px),
        "window": list(window) if window is not None else None,
        "label": {**onset.row(), **about},
        "starts": (recording.starts[first : stop + 1] - recording.starts[first]).tolist(),
        "x": _packed(events.x, "<u2"),
        "y": _packed(events.y, "<u2"),
        "p": _packed(events.p, "<u1"),
        "counts": counts.tolist(),
        "flow": None if flow is None else [_or_none(value) for value in flow.relative_flow_px[first:stop].tolist()],
        "overview": _overview(recording),
    }
    return data | _dots(recording, first, stop)


def _span(starts: NDArray[np.int64], middle: int) -> tuple[int, int]:
    """Return the range of slices around a slice, shorter if it has too many events."""
    slices = len(starts) - 1
    before, after = BEFORE_MS, AFTER_MS
    while True:
        first, stop = max(middle - before, 0), min(middle + after, slices)
        if before <= SHORTEST_MS or starts[stop] - starts[first] <= MOST_EVENTS:
            return first, stop
        before, after = max(before // 2, SHORTEST_MS), max(after // 2, SHORTEST_MS)


def _window_counts(recording: Recording, first: int, stop: int) -> NDArray[np.int64]:
    """Return the number of events in the window in each slice, or in the whole frame without a window."""
    events, window = recording.between(first, stop), recording.window_px
    slices = events.t // 1000 - first
    if window is not None:
        x0, y0, x1, y1 = window
        slices = slices[(events.x >= x0) & (events.x < x1) & (events.y >= y0) & (events.y < y1)]
    return np.bincount(slices, minlength=stop - first)


def _overview(recording: Recording) -> dict[str, Any]:
    """Return the events of the whole recording in bins, with the width of a bin in slices."""
    slices = len(recording)
    width = max(-(-slices // MOST_BINS), 1)
    edges = np.minimum(np.arange(0, slices + width, width), slices)
    return {"ms": width, "events": np.diff(recording.starts[edges]).tolist()}


def _dots(recording: Recording, first: int, stop: int) -> dict[str, Any]:
    """Return the tracked dots at the end of each slice, and the mean distance of the three farthest from rest."""
    grid, radius_px = recording.dot_xy_px, recording.dot_radius_px
    if grid is None or radius_px is None:
        return {"dots": 0}
    rest = np.ascontiguousarray(grid.reshape(-1, 2)[np.isfinite(grid.reshape(-1, 2)).all(axis=1)], np.float64)
    begin = max(first - TRACKED_MS, 0)
    try:
        constants = PRESETS["stable"].for_dots(radius_px, recording.sensitivity.contrast_over_threshold)
        state = tracker.start(rest, constants, frame_px=recording.frame_px)
        events = recording.between(begin, stop)
        starts = recording.starts[begin : stop + 1] - recording.starts[begin]
        dots = tracker.fold(state, events.x, events.y, events.p, starts).dot_xy_px[first - begin :]
    except ValueError:  # the tracker does not support this grid or frame
        return {"dots": 0}
    away = np.sort(np.hypot(*np.moveaxis(dots - rest, 2, 0)), axis=1)[:, -3:].mean(axis=1)
    return {
        "dots": len(rest),
        "radius": radius_px,
        "rest": _packed(rest, "<f4"),
        "at": _packed(dots, "<f4"),
        "away": [round(value, 4) for value in away.tolist()],
    }


def _packed(array: NDArray[Any], kind: str) -> str:
    return b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


def _or_none(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
