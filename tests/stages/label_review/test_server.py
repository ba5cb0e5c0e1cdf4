"""The page of a review, as served: what it is told of a recording, what it may do, and who may not."""

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.commands.label import Label
from evetac_cli.errors import InputError
from evetac_cli.stages import label, label_review
from evetac_cli.store.files import StageFile
from tests import small_files
from tests.patience import PATIENCE_S


class Reviewed:
    """A review of two recordings, in a thread of its own."""

    def __init__(self, folder: Path) -> None:
        from evetac_cli.stages.label_review.server import ReviewServer

        self.recordings = [folder / f"{name}.recording.h5" for name in "ab"]
        for path in self.recordings:
            small_files.recording(path, lost_slices=False)
        self.labels = [folder / f"{name}.labels.h5" for name in "ab"]
        self.server = ReviewServer(self.recordings, self.labels, Label(by="Ada", after_ms=5))
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()

    def ask(self, path: str, sent: Any = None, token: str | None = None, **headers: str) -> tuple[int, Any]:
        """Status and answer of a request with the token; with something to send, as the page sends it."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=PATIENCE_S)
        where = f"/{self.server.token if token is None else token}/{path}"
        own = {"Origin": f"http://127.0.0.1:{self.server.port}"}
        body = None if sent is None else json.dumps(sent)
        connection.request("GET" if sent is None else "POST", where, body, {**(own if body else {}), **headers})
        try:
            answer = connection.getresponse()
            text, kind = answer.read(), answer.getheader("Content-Type", "")
        finally:
            connection.close()
        return answer.status, json.loads(text) if kind.startswith("application/json") else text

    def close(self) -> None:
        """End it."""
        if self.thread.is_alive():
            self.ask("done", {})
        self.thread.join(PATIENCE_S)
        self.server.close()


@pytest.fixture
def reviewed(tmp_path: Path) -> Iterator[Reviewed]:
    """A review."""
    review = Reviewed(tmp_path)
    yield review
    review.close()


def test_a_recording_is_shown_with_its_label(reviewed: Reviewed) -> None:
    """Assert that the page gets events, dots and onset, without truth, computed first and as kept later."""
    status, data = reviewed.ask("trial?n=1")
    assert status == 200
    assert (data["name"], data["n"], data["of"], data["by"]) == ("b.recording.h5", 1, 2, "Ada")
    assert data["simulated"] is True
    assert not any("truth" in name for name in data)
    first, stop = data["span"]
    assert len(data["counts"]) == len(data["starts"]) - 1 == stop - first
    assert data["label"]["kept"] is False
    status, answer = reviewed.ask(
        "keep", {"n": 1, "onset": data["start"] + 3, "earliest": -1, "latest": -1, "can_tell": True}
    )
    assert (status, answer["row"]["onset_ms"], answer["row"]["by"]) == (200, data["start"] + 3, "Ada")
    later = reviewed.ask("trial?n=1&at=5")[1]["label"]
    assert (later["kept"], later["method"], later["by"], later["onset_ms"]) == (
        True,
        "person",
        "Ada",
        data["start"] + 3,
    )
    with StageFile(reviewed.labels[1], "labels") as file:
        assert file.header["parameters"]["by"] == "Ada"
    assert not reviewed.labels[0].exists()
    assert [row["output"] for row in reviewed.server.rows] == [str(reviewed.labels[1])]


@pytest.mark.parametrize(
    ("path", "sent", "headers", "status"),
    [
        ("trial?n=2", None, {}, 404),
        ("trial?n=-1", None, {}, 400),
        ("trial?n=0&at=1e3", None, {}, 400),
        ("keep", {"n": "0", "onset": 3}, {}, 404),
        ("keep", {"n": 0, "onset": 3.5}, {}, 400),
        ("keep", {"n": 0, "onset": 3, "can_tell": 1}, {}, 400),
        ("keep", [0], {}, 400),
        ("keep", {"n": 0, "onset": 3}, {"Origin": "http://evil.example"}, 403),
        ("keep", {"n": 0, "onset": 3}, {"Host": "evil.example"}, 403),
        ("done", {}, {"Origin": "http://evil.example"}, 403),
        ("labels", None, {}, 404),
    ],
)
def test_what_is_not_from_the_page_is_refused(
    reviewed: Reviewed, path: str, sent: Any, headers: dict[str, str], status: int
) -> None:
    """Assert that wrong numbers, other origins, hosts and kinds of content are refused, and nothing is written."""
    assert reviewed.ask(path, sent, **headers)[0] == status
    assert reviewed.thread.is_alive()
    assert not any(path.exists() for path in reviewed.labels)


def test_without_the_token_nothing_is_answered(reviewed: Reviewed) -> None:
    """Assert that page, data and verdicts all ask for the token."""
    for path, sent in (
        ("", None),
        ("page.js", None),
        ("trial?n=0", None),
        ("keep", {"n": 0, "onset": 3}),
        ("done", {}),
    ):
        assert reviewed.ask(path, sent, token="wrong")[0] == 403
    assert [reviewed.ask(name)[0] for name in ("", "page.js", "page.css")] == [200, 200, 200]


def test_the_stage_serves_until_the_person_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the command has one job of all recordings, ends when asked to, and its rows are what was kept."""
    reviewed = Reviewed(tmp_path)
    reviewed.close()
    chosen = Label(review=True, by="Ada", after_ms=5)
    (job,) = label.jobs(reviewed.recordings, chosen, None)
    assert job.outputs == tuple(reviewed.labels)
    from evetac_cli.stages.label_review import server as served

    def ask(server: Any) -> None:
        reviewed.server = server
        reviewed.ask("keep", {"n": 0, "onset": -1})
        assert reviewed.ask("done", {}) == (200, {"kept": 1})

    class Quick(served.ReviewServer):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            threading.Thread(target=ask, args=(self,)).start()

    monkeypatch.setattr(served, "ReviewServer", Quick)
    outcome = label.run(job, chosen)
    assert [(row["output"], row["onset_ms"]) for row in outcome.rows] == [(str(reviewed.labels[0]), None)]
    assert outcome.simulated
    with pytest.raises(InputError, match="no such folder"):
        label_review.run(label_review.jobs(reviewed.recordings, tmp_path / "none")[0], chosen)


@pytest.mark.parametrize("option", [{"method": "farneback"}, {"slip_distance_px": 0.5}, {"from_start": True}])
def test_options_of_methods_are_refused(tmp_path: Path, option: dict[str, Any]) -> None:
    """Assert that what decides how a method labels is not taken in silence where a person does."""
    (name,) = option
    with pytest.raises(InputError, match=f"--{name.replace('_', '-')}") as error:
        label.jobs([tmp_path / "a.recording.h5"], Label(review=True, **option), None)
    assert "leave out" in str(error.value)
