"""evaluate data-rate: shares of an RGB sensor's rate, where contact and slip are known from, what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.evaluate.data_rate import EvaluateDataRate
from evetac_cli.evaluate.data_rate import measure as data_rate
from evetac_cli.events import Events
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from tests.make import event_arrays, events_at, label_arrays, run_stage, truth_arrays, write_recording

TOUCH, LOST, ONSET, SLICES = 200, 1400, 1000, 2000
RGB_BYTES_S = 540 * 480 * 3 * 25


def recording_file(
    path: Path,
    per_slice: NDArray[np.int64],
    *,
    truth: bool = False,
    onset: int = ONSET,
    touched: bool = True,
    scene: str | None = None,
    parameters: dict[str, Any] | None = None,
) -> Path:
    """A recording with so many events in each slice; with truth, in contact from TOUCH to LOST and slip from onset."""
    slices = len(per_slice)
    arrays = event_arrays(events_at(np.repeat(np.arange(slices) * 1000, per_slice)), slices)
    if truth:
        at = np.arange(slices)
        loaded = (at >= TOUCH) & (at < LOST) & touched
        slips = (at >= onset) & (at < onset + 20)
        arrays |= truth_arrays(np.zeros((slices, 1, 2)), slips, np.where(loaded, 2.0, 0.0))
    parameters = {**(parameters or {}), **({} if scene is None else {"scene": {"name": scene}})}
    return write_recording(path, arrays, simulated=truth, **parameters)


def labels_file(recording: Path, onset: int, *, of: Path | None = None, doubt: str = "") -> None:
    with open_recording(of or recording) as source:
        header, slices = source.header, len(source)
    label = np.zeros(slices, np.int8)
    label[onset:] = -1 if doubt else onset >= 0
    arrays = label_arrays(label, onset)
    arrays |= {"abstained": np.uint8(1), "doubt": doubt} if doubt else {}
    path = recording.with_name(recording.name.replace(".recording.", ".labels."))
    write_stage(path, Recipe("labels", 1, {}, parents=(header,)), arrays, force=True)


def evaluated(*files: Path, **values: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of recordings, and of intervals."""
    params = EvaluateDataRate(**values)
    rows = run_stage(data_rate, list(files), params, files[0].with_name("a.report.h5"), force=True)[1].rows
    return [row for row in rows if "file" in row], [row for row in rows if "interval" in row]


def steps() -> NDArray[np.int64]:
    """1 event a slice at rest, 10 in contact, 100 in the 0.5 s about the onset."""
    at = np.arange(SLICES)
    return np.where((at >= 750) & (at < 1250), 100, np.where((at >= TOUCH) & (at < LOST), 10, 1))


def test_objects_have_rows_where_there_are_several(tmp_path: Path) -> None:
    """Assert a row per interval over all recordings, and one per object with the figures of its own."""
    paths = [tmp_path / f"{number}.recording.h5" for number in (1, 2, 3)]
    for number, path in zip((1, 1, 2), paths, strict=True):
        recording_file(path, number * steps(), truth=True, parameters={"object": number})
    rows = evaluated(*paths)[1]
    assert [(row["object"], row["interval"]) for row in rows] == [
        (name, interval) for name in ("all", "1", "2") for interval in data_rate.INTERVALS
    ]
    shares = {row["object"]: row["share_mean"] for row in rows if row["interval"] == "slip"}
    assert shares["2"] == pytest.approx(2 * shares["1"]) and shares["all"] == pytest.approx(4 / 3 * shares["1"])
    assert [row["object"] for row in evaluated(paths[2])[1]] == ["all"] * 3


def test_shares_in_closed_form(tmp_path: Path) -> None:
    """Assert the share of each interval for events that come in steps: 5 bytes each, against 19.44 MB/s."""
    path = recording_file(tmp_path / "a.recording.h5", steps(), truth=True)
    ((row,), intervals) = evaluated(path)
    counts = {"whole": (800 + 700 * 10 + 500 * 100) / 2000, "contact": (7000 + 50000) / 1200, "slip": 100}
    for name, a_slice in counts.items():
        assert row[f"share_{name}"] == pytest.approx(a_slice * 5 * 1000 / RGB_BYTES_S)
        assert row[f"bytes_s_{name}"] == pytest.approx(a_slice * 5 * 1000)
    assert (row["contact_from_ms"], row["contact_to_ms"], row["slip_ms"]) == (TOUCH, LOST, ONSET)
    assert row["not_measured"] is None
    assert [interval["paper_share_mean"] for interval in intervals] == [0.017, 0.028, 0.119]
    assert [interval["share_sd"] for interval in intervals] == [None] * 3


def test_the_papers_figures_are_about_its_own_motions(tmp_path: Path) -> None:
    """Assert that beside a simulation of another scene stands none of the paper's figures, and that this is said."""
    own = recording_file(tmp_path / "a.recording.h5", steps(), truth=True, scene="data-rate")
    other = recording_file(tmp_path / "b.recording.h5", 2 * steps(), truth=True, scene="slip")
    rows, intervals = evaluated(own)
    assert [row["paper_share_mean"] for row in intervals] == [0.017, 0.028, 0.119]
    assert len(data_rate.for_people([*rows, *intervals], EvaluateDataRate())[1]) == 3
    for files in ((other,), (own, other)):
        rows, intervals = evaluated(*files)
        for row in intervals:
            assert {row[name] for name in row if "paper" in name} == {None}
        assert "not shown" in data_rate.for_people([*rows, *intervals], EvaluateDataRate())[1][-1]


def test_the_interval_about_slip_is_settable(tmp_path: Path) -> None:
    """Assert the bytes per second of a second around the onset."""
    path = recording_file(tmp_path / "a.recording.h5", steps(), truth=True)
    ((about,), _) = evaluated(path, around_s=1.0)
    assert about["bytes_s_slip"] == pytest.approx((500 * 100 + 400 * 10 + 100) / 1000 * 5000)


def test_mean_and_sd_over_trajectories(tmp_path: Path) -> None:
    """Assert mean and sd over recordings, of those alone that have an answer."""
    one = recording_file(tmp_path / "a.recording.h5", steps(), truth=True)
    two = recording_file(tmp_path / "b.recording.h5", 3 * steps(), truth=True)
    plain = recording_file(tmp_path / "c.recording.h5", steps())
    rows, intervals = evaluated(one, two, plain)
    assert [interval["trajectories"] for interval in intervals] == [3, 2, 2]
    assert [interval["left_out"] for interval in intervals] == [0, 1, 1]
    said = data_rate.for_people([*rows, *intervals], EvaluateDataRate())[1]
    assert said[1].endswith("; n = 2 of 3 recordings, left out: no truth (1).")
    for interval in intervals:
        shares = [row[f"share_{interval['interval']}"] for row in rows if row[f"share_{interval['interval']}"]]
        assert interval["share_mean"] == pytest.approx(np.mean(shares))
        assert interval["share_sd"] == pytest.approx(np.std(shares, ddof=1))


def test_slip_from_labels(tmp_path: Path) -> None:
    """Assert that without truth the onset is that of the labels beside it, and contact is refused in words."""
    path = recording_file(tmp_path / "a.recording.h5", steps())
    labels_file(path, ONSET)
    ((row,), _) = evaluated(path)
    assert row["share_slip"] == pytest.approx(100 * 5 * 1000 / RGB_BYTES_S)
    assert row["share_contact"] is None
    assert row["not_measured"].startswith("contact: no truth")
    with StageFile(tmp_path / "a.report.h5") as report:
        kinds = {report.header["history"][parent]["kind"] for parent in report.header["parents"]}
    assert kinds == {"recording", "labels"}


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({}, "slip: neither truth nor labels"),
        ({"labels": -1}, "slip: no slip in the labels"),
        ({"labels": ONSET, "doubt": "the slide stopped: twice"}, "slip: the labels abstain: the slide stopped"),
        ({"labels": 1900}, "slip: too little around the onset: 0.35 s of 0.5 s around the onset at 1900 ms"),
        ({"truth": True, "onset": SLICES}, "slip: no slip"),
        ({"truth": True, "touched": False}, "contact: nothing was touched"),
    ],
)
def test_what_cannot_be_answered_is_said(tmp_path: Path, how: dict[str, Any], reason: str) -> None:
    """Assert that an interval that is not known is left out with its reason, and the whole is answered all the same."""
    labels, doubt = how.pop("labels", None), how.pop("doubt", "")
    path = recording_file(tmp_path / "a.recording.h5", steps(), **how)
    if labels is not None:
        labels_file(path, labels, doubt=doubt)
    ((row,), intervals) = evaluated(path)
    assert reason in row["not_measured"]
    assert row[f"share_{reason.partition(':')[0]}"] is None
    assert row["share_whole"] > 0
    assert intervals[0]["share_mean"] == row["share_whole"]
    (without,) = [one for one in intervals if one["interval"] == reason.partition(":")[0]]
    assert (without["trajectories"], without["left_out"]) == (0, 1)
    said = f"{without['interval']}: unknown; n = 0 of 1 recordings, left out: {without['left_out_because']}."
    assert said in data_rate.for_people([row, *intervals], EvaluateDataRate())[1]
    assert without["left_out_because"].endswith(" (1)") and "350" not in without["left_out_because"]


def test_the_window_stands_beside(tmp_path: Path) -> None:
    """Assert that events from column 540 on count for the window alone, and both shares together are those of all."""
    per_slice = 3 * steps()
    t_us = np.repeat(np.arange(SLICES) * 1000, per_slice)
    x = np.tile([0, 539, 540], len(t_us) // 3).astype(np.uint16)
    zeros = np.zeros(len(t_us), np.uint8)
    arrays = event_arrays(Events(t_us, x, zeros.astype(np.uint16), zeros), SLICES)
    path = write_recording(tmp_path / "a.recording.h5", arrays)
    labels_file(path, ONSET)
    ((row,), (whole, _, slip)) = evaluated(path)
    assert row["share_slip"] == pytest.approx(200 * 5 * 1000 / RGB_BYTES_S)
    assert row["window_share_slip"] == pytest.approx(100 * 5 * 1000 / RGB_BYTES_S)
    every = per_slice.mean() * 5 * 1000 / RGB_BYTES_S
    assert row["share_whole"] + row["window_share_whole"] == pytest.approx(every)
    assert (row["events"], row["events_of_window"]) == (len(t_us), len(t_us) // 3)
    assert row["max_bytes_per_slice"] == 200 * 5
    assert (whole["columns"], whole["window_share_mean"]) == (540, row["window_share_whole"])
    assert slip["window_share_mean"] == row["window_share_slip"]


def test_labels_of_another_recording_are_refused(tmp_path: Path) -> None:
    """Assert that labels beside a recording that were made from another one are an error at their place."""
    path = recording_file(tmp_path / "a.recording.h5", steps())
    labels_file(path, ONSET, of=recording_file(tmp_path / "b.recording.h5", 2 * steps()))
    with pytest.raises(InputError):
        evaluated(path)
