"""A person's labels: what is kept of a verdict, where it is from, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.label import Label
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.stages import label
from evetac_cli.stages.label_review import person
from evetac_cli.stages.label_review.person import Verdict
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.onset import abstains, labelled_onset
from evetac_cli.store.recordings.read import open_recording
from tests.small_files import recording_of


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of 100 slices, without a gripper."""
    return recording_of(tmp_path / "a.recording.h5", [3] * 100)


def kept(recording: Path, verdict: Verdict, by: str = "Ada") -> tuple[Path, dict[str, Any]]:
    """The labels of a verdict, beside the recording, and their row."""
    labels = recording.with_name("a.labels.h5")
    with open_recording(recording) as opened:
        return labels, person.keep(opened, labels, verdict, by, 10)


def test_an_onset_is_kept_with_who_gave_it(recording: Path) -> None:
    """Assert that labels are valid, name person and interval, and label 10 ms from the onset on as slip."""
    path, row = kept(recording, Verdict(40, 38, 43))
    assert [result["faults"] for result in validate.run([path]).rows] == [None]
    with StageFile(path, "labels") as file:
        expected = np.where(np.arange(100) < 40, 0, np.where(np.arange(100) < 50, 1, -1))
        np.testing.assert_array_equal(file.read("label"), expected)
        told = labelled_onset(file)
        assert (told.slice_, told.earliest, told.latest, told.abstained) == (40, 38, 43, False)
        made = file.header["parameters"]
        assert (made["method"], made["by"], made["replaced"]) == ("person", "Ada", [])
        assert row["kept_at"] == file.header["made"]["at"]
    assert (row["onset_ms"], row["by"], row["replaced_onset_ms"]) == (40, "Ada", None)


def test_what_was_replaced_stays_in_the_header(recording: Path) -> None:
    """Assert that labels know what stood before them, all of it, the oldest first, and are other labels for it."""
    first, _ = kept(recording, Verdict(40, 38, 43))
    with StageFile(first) as file:
        id_ = file.header["id"]
    _, row = kept(recording, Verdict(45), "Grace")
    assert (row["replaced_method"], row["replaced_onset_ms"]) == ("person", 40)
    path, _ = kept(recording, Verdict(-1), "Ada")
    with StageFile(path) as file:
        before = file.header["parameters"]["replaced"]
        assert [(one["by"], one["onset_slice"]) for one in before] == [("Ada", 40), ("Grace", 45)]
        assert before[0]["id"] == id_
        assert (before[0]["earliest_slice"], before[0]["latest_slice"]) == (38, 43)
        assert set(file.read("label")) == {0}
        assert int(file.read("onset_slice")) == -1


@pytest.mark.parametrize(
    ("verdict", "unknown"), [(Verdict(40, 38, 43, False), range(38, 44)), (Verdict(40, can_tell=False), [40])]
)
def test_an_onset_that_cannot_be_told_is_not_examined(recording: Path, verdict: Verdict, unknown: Any) -> None:
    """Assert that the slices of its interval, or its own, are neither slip nor no slip, and the labels abstain."""
    path, row = kept(recording, verdict)
    assert [result["faults"] for result in validate.run([path]).rows] == [None]
    with StageFile(path) as file:
        assert np.flatnonzero(file.read("label")[:50] == -1).tolist() == list(unknown)
        assert abstains(file)
        assert "could not decide" in labelled_onset(file).in_words()
    assert row["abstained"]


@pytest.mark.parametrize(
    "verdict",
    [Verdict(100), Verdict(-2), Verdict(40, 41, 43), Verdict(40, 30, 39), Verdict(-1, 3, 4), Verdict(40, 39, 100)],
)
def test_impossible_verdicts_are_refused(recording: Path, verdict: Verdict) -> None:
    """Assert that an onset, or an interval, that cannot be is an error, and nothing is written."""
    with pytest.raises(InputError, match="no such (onset|interval)"):
        kept(recording, verdict)
    assert not recording.with_name("a.labels.h5").exists()


def test_another_method_does_not_take_the_place_of_a_person(recording: Path) -> None:
    """Assert that `label` refuses to write over a person's labels, and says that --force does."""
    path, _ = kept(recording, Verdict(40))
    (job,) = label.jobs([recording], Label(method="event-count"), None)
    assert job.output == path
    with pytest.raises(InputError, match=r"(?s)--force"):
        label.run(job, Label(method="event-count"))


def test_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a name is trimmed, and that of the login stands in for none."""
    monkeypatch.setattr("getpass.getuser", lambda: "ada")
    assert (person.name_of(" Ada L. "), person.name_of("")) == ("Ada L.", "ada")
    with pytest.raises(InputError, match="--by"):
        label.jobs([Path("a.recording.h5")], Label(by="Ada"), None)
