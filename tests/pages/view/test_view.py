"""view: what is shown of a trial, which files belong to it, and the page as a file."""

import base64
import html
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.view import View
from evetac_cli.errors import EvetacError
from evetac_cli.pages import shared, view
from evetac_cli.pages.view import event_images, time_series, touch
from evetac_cli.pages.view.trial_files import open_trial
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.streams import Stream
from tests import small_files
from tests.make import evetac
from tests.pages.view.trials import (
    GRIPPED,
    NASTY,
    ONSET,
    SLICES,
    moving,
    page_data,
    shown,
    write_labels,
    write_recording,
    write_touch,
    write_tracks,
)


def test_everything_of_a_trial(trial: Path) -> None:
    """Assert that panels, lanes, onsets and dots are there, and that truth says simulated."""
    data = shown(trial)
    assert [panel.title for panel in data.panels] == [
        "Events per millisecond",
        "Gripper, current",
        "Gripper, width between the fingers",
        "Forces on one pad, truth",
        "Share of the contact that slips, truth",
        "Dots, distance from rest",
        "Flow that labels slip",
    ]
    assert [panel.simulated for panel in data.panels] == [False, True, True, True, True, False, False]
    events, current, _, forces, shares, dots, flow = data.panels
    assert [line.name for line in shares.lines] == ["that the camera sees", "whole"]
    assert (events.lines[0].value == 4).all()
    assert current.lines[0].t_s[-1] == pytest.approx(0.298)
    np.testing.assert_allclose(forces.lines[1].value, np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(dots.lines[1].value, np.linspace(0, 4, SLICES), atol=1e-5)
    assert flow.levels == {"threshold": 0.3}
    assert data.onsets == {"truth": ONSET, "label": ONSET + 3}
    truth, label = data.lanes
    assert truth.slip == [(0.2, 0.3)]
    assert (label.slip, label.unknown) == ([(0.203, 0.3)], [(0.0, 0.05)])
    assert data.frame_times.tolist() == list(range(SLICES - 4))
    assert data.dot_xy_px is not None
    np.testing.assert_allclose(data.dot_xy_px, moving()[4:].astype(np.float32))


def test_touch_of_the_trial_is_shown(trial: Path) -> None:
    """Assert that touch beside the trial is shown, alone too, and that of another trial is not."""
    path = write_touch(trial)
    (panel,) = [panel for panel in shown(trial).panels if panel.title == "Force on the gel, estimated"]
    assert [line.name for line in panel.lines] == ["normal", "shear", "shear since rest"]
    np.testing.assert_allclose(panel.lines[1].value, np.sqrt(2), rtol=1e-6)
    assert shown(path).slices == SLICES
    other = write_recording(trial.with_name("b.recording.h5"), seed=2)
    tracks = write_tracks(trial.with_name("b.tracks.h5"), other, moving())
    small_files.touch(path, tracks)
    data = shown(trial)
    assert "Left out: a.touch.h5 was made from another recording." in data.notes
    assert data.touch is None and not [panel for panel in data.panels if "estimated" in panel.title]


def test_each_image_has_the_map_before_its_end(trial: Path) -> None:
    """Assert which map an image is shown with, its values within a step of the scale, and what its slice tells."""
    rng = np.random.default_rng(1)
    pressure = rng.uniform(0, 5e4, (3, 4, 5)).astype(np.float32)
    shear = rng.normal(0, 1e4, (3, 2, 4, 5)).astype(np.float32)
    patch = np.ones((3, 4, 5), np.uint8)
    patch[0, 0] = 0
    pressure[0, 0], shear[0, :, 0] = 0, 0
    centre = np.stack([np.arange(SLICES), np.zeros(SLICES)], axis=1).astype(np.float32)
    changes = {"map/slice": np.array([50, 120, 121]), "map/pressure_pa": pressure, "map/shear_pa": shear}
    sds = {"map/shear_sd_pa": np.abs(shear) + 1, "map/pressure_sd_pa": pressure / 2, "map/patch": patch}
    write_touch(trial, {**changes, **sds, "centre_mm": centre})
    data = shown(trial)
    maps = data.touch
    assert maps is not None
    ends = data.frame_times + data.shown_ms - 1
    np.testing.assert_array_equal(maps["shown"], np.searchsorted([50, 120, 121], ends, side="right") - 1)
    assert maps["shown"][0] == -1 and maps["shown"][-1] == 2
    np.testing.assert_array_equal(maps["centre_mm"][:, 0], ends)
    most_pa, most_shear_pa = 1e3 * maps["most_kpa"], 1e3 * maps["most_shear_kpa"]
    np.testing.assert_allclose(maps["pressure"] / 255 * most_pa, np.minimum(pressure, most_pa), atol=most_pa / 509)
    within = np.clip(shear, -most_shear_pa, most_shear_pa)
    shown_pa = (maps["shear"] - 127.0) / 127 * most_shear_pa
    np.testing.assert_allclose(shown_pa, within, atol=most_shear_pa / 253)
    np.testing.assert_array_equal(maps["patch"], patch)
    at = np.unravel_index(pressure[1].argmax(), (4, 5))
    highest_pa = 1e3 * maps["highest_kpa"][1, :2]
    np.testing.assert_allclose(highest_pa, [pressure[1][at], pressure[1][at] / 2], rtol=1e-6)
    in_page = page_data_of(trial)["touch"]
    assert in_page["most_kpa"] == maps["most_kpa"] and in_page["shown"] == maps["shown"]
    assert base64.b64decode(in_page["pressure"]) == maps["pressure"].tobytes()


def test_touch_maps_stay_few(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a page keeps as many maps as it has room for, evenly, says so, and shows none that is to come."""
    maps = 60
    changes = {"map/slice": np.arange(maps) * 5, "map/patch": np.ones((maps, 4, 5), np.uint8)}
    changes |= {f"map/{name}": np.ones((maps, 4, 5), np.float32) for name in ("pressure_pa", "pressure_sd_pa")}
    changes |= {f"map/{name}": np.ones((maps, 2, 4, 5), np.float32) for name in ("shear_pa", "shear_sd_pa")}
    write_touch(trial, changes)
    monkeypatch.setattr(touch, "MAP_BYTES", 20 * 4 * 4 * 5)
    data = shown(trial)
    assert data.touch is not None and len(data.touch["pressure"]) == 20
    assert any(note.startswith("Touch maps: one in 3 is kept") for note in data.notes)
    ends = data.frame_times + data.shown_ms - 1
    begun = 15 * np.array(data.touch["shown"])
    assert (begun <= ends).all() and (ends - begun < 15).all()


def page_data_of(trial: Path) -> dict[str, Any]:
    """The data in the page of a trial."""
    view.run([trial], View(), None, force=True)
    return page_data(trial.with_name("a.html"))


def test_a_part(trial: Path) -> None:
    """Assert that --start-s and --stop-s bound images and series, and that nothing is found before the start."""
    data = shown(trial, start_s=0.22, stop_s=0.25)
    assert data.span == (220, 250)
    assert (data.frame_times[0], data.frame_times[-1]) == (220, 245)
    assert all(0.22 <= t < 0.25 for panel in data.panels for line in panel.lines for t in line.t_s)
    assert data.onsets == {"truth": 220, "label": 220}
    assert shown(trial, stop_s=99.0).span == (0, SLICES)


def test_labels_that_abstain_say_so(trial: Path) -> None:
    """Assert that a page notes why labels abstain, and shows the interval of their onset; and who labelled by hand."""
    with open_recording(trial) as recording:
        header = recording.header
    told = {"earliest_slice": np.int64(ONSET - 5), "latest_slice": np.int64(ONSET + 5), "doubt": "it is <slow>"}
    arrays = {"onset_slice": np.int64(ONSET), "abstained": np.uint8(1), **told}
    write_labels(trial.with_name("a.labels.h5"), header, ONSET, method="person", by="Ada", unknown=5, arrays=arrays)
    data = shown(trial, images=1)
    assert "The labels abstain: it is <slow>." in data.notes
    assert "The labels were made by a person: Ada." in data.notes
    assert data.onsets["label"] == ONSET
    view.run([trial], View(images=1), None)
    text = trial.with_name("a.html").read_text(encoding="utf-8")
    assert f"abstains, within {(ONSET - 5) / 1000:.3f} to {(ONSET + 5) / 1000:.3f} s" in text
    assert "it is &lt;slow&gt;" in text


def test_without_the_recording(trial: Path) -> None:
    """Assert that tracks alone show dots and their series, and say that there are no event images."""
    trial.unlink()
    data = shown(trial.with_name("a.tracks.h5"))
    assert data.pictures == []
    assert data.dot_xy_px is not None
    assert "no event images" in data.notes[0]
    data = shown(trial.with_name("a.labels.h5"))
    assert [panel.title for panel in data.panels][-1] == "Flow that labels slip"
    view.run([trial.with_name("a.labels.h5")], View(), None)


def test_strangers_beside_are_left_out(trial: Path, tmp_path: Path) -> None:
    """Assert that labels of another recording and truncated tracks beside a recording are left out, with a note."""
    other = write_recording(tmp_path / "b.recording.h5", scene="other")
    (tmp_path / "a.labels.h5").unlink()
    write_labels(tmp_path / "a.labels.h5", other)
    tracks = tmp_path / "a.tracks.h5"
    os.truncate(tracks, tracks.stat().st_size // 2)
    with open_trial([trial]) as opened:
        assert [file.kind for file in opened.files] == ["recording"]
        assert sorted(note.split(":")[1].split()[0] for note in opened.notes) == ["a.labels.h5", "a.tracks.h5"]


def test_tracks_that_are_short(trial: Path) -> None:
    """Assert that tracks which end early make a page, and that it says where they end."""
    with open_recording(trial) as recording:
        header = recording.header
    dots = moving(120)
    tracks = trial.with_name("a.tracks.h5")
    tracks.unlink()
    write_tracks(tracks, header, dots)
    data = shown(trial)
    assert "tracks end at 0.120 s, 180 ms before" in data.notes[0]
    assert data.dot_xy_px is not None
    assert np.isnan(data.dot_xy_px[116:]).all()
    assert np.isfinite(data.dot_xy_px[100:116]).all()


@pytest.mark.parametrize("slices", [0, 1, 7])
def test_next_to_nothing(tmp_path: Path, slices: int) -> None:
    """Assert that recordings without a slice, with one, and without events make a page; the empty one says so."""
    path = tmp_path / "a.recording.h5"
    write_recording(path, slices, rate=0, truth=False)
    outcome = view.run([path], View(), None)
    text = (tmp_path / "a.html").read_text()
    assert ("This recording is empty" in text) == (slices == 0)
    assert ("There are no events" in text) == (slices > 0)
    assert outcome.rows[0]["images"] == min(slices, max(1, slices - 4))


def test_nothing_long_is_read_at_once(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that dots and forces, which are gigabytes in an hour, are read in blocks."""
    from evetac_cli.store.files import StageFile
    from evetac_cli.store.layout import contents

    monkeypatch.setattr(contents, "SMALL_VALUES", 0)  # opening reads what is small, as all is in this trial
    longest: dict[str, int] = {}
    read = StageFile.read

    def spy(self: StageFile, path: str, start: int = 0, stop: int | None = None) -> Any:
        value = read(self, path, start, stop)
        if np.ndim(value):
            longest[f"{self.kind} {path}"] = max(longest.get(f"{self.kind} {path}", 0), len(value))
        return value

    monkeypatch.setattr(StageFile, "read", spy)
    for name, value in {"BINS": 20, "BLOCK_ROWS": 40}.items():
        monkeypatch.setattr(time_series, name, value)
    data = shown(trial, images=5)
    assert all(len(line.value) <= 40 for panel in data.panels for line in panel.lines)
    for path in ("recording truth/normal_force_n", "labels relative_flow_px", "recording gripper/current_ma"):
        assert longest[path] <= 60, path


def test_command(trial: Path) -> None:
    """Assert that the command writes NAME.html beside the file, says so in the one shape, and keeps what exists."""
    result = evetac("view", trial, "--json", "--images", "5")
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    (row,) = answer["rows"]
    page = trial.with_name("a.html")
    assert (answer["command"], answer["simulated"], row["page"]) == ("view", True, str(page))
    assert row["size_bytes"] == page.stat().st_size < shared.LARGEST_BYTES
    assert (row["images"], row["files"]) == (5, "a.recording.h5 a.tracks.h5 a.labels.h5")
    before = page.read_bytes()
    result = evetac("view", trial)
    assert result.exit_code == 2
    assert "the output exists" in result.stderr
    assert page.read_bytes() == before
    assert evetac("view", trial, "--force", "-q", "--images", "4").output == ""
    assert page.read_bytes() != before
    assert sorted(path.name for path in trial.parent.glob(".*")) == []


def test_text_from_files_is_escaped(tmp_path: Path) -> None:
    """Assert that names and scenes which look like markup stay text."""
    path = tmp_path / "a\"'<img src=x onerror=alert(1)>@@DATA@@ü.recording.h5"
    write_recording(path, 20, scene=NASTY)
    view.run([path], View(), tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert "document.title='owned'" not in text
    assert "<img" not in text
    assert html.escape(path.name) in text
    assert len(page_data(tmp_path / "p.html")["frame_times"]) == 16


def test_page_is_bounded(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that images are thinned evenly where they would be too many bytes, with a note; else it is refused."""
    whole = shown(trial)
    size = sum(map(len, whole.pictures))
    monkeypatch.setattr(event_images, "IMAGE_BYTES", size // 3)
    data = shown(trial)
    assert sum(map(len, data.pictures)) <= size // 3
    assert data.frame_times.tolist() == whole.frame_times.tolist()[::4]
    assert "only every 4th" in data.notes[-1]
    assert len(data.events) == len(data.pictures) == len(data.frame_times)
    monkeypatch.setattr(shared, "LARGEST_BYTES", 1_000_000)
    with pytest.raises(EvetacError, match="too large"):
        view.run([trial], View(images=1), None)


@pytest.mark.parametrize(
    ("unit", "values", "marks"),
    [
        ("", [6, 7, 9, 8], True),  # sources of triggers
        ("", range(300), False),  # a counter
        ("mm", [0, 1, 1, 0], False),
    ],
)
def test_codes_are_marks(trial: Path, unit: str, values: Any, marks: bool) -> None:
    """Assert that whole numbers without a unit, few of them, are drawn each by itself, and quantities as a line."""
    column = np.resize(np.asarray(list(values), float), 300)
    stream = Stream("box", np.arange(300, dtype=np.int64) * 1000, {"state": column}, units={"state": unit})
    recording = trial.with_name("s.recording.h5")
    write_recording(recording, truth=False, more=stream.datasets())
    (panel,) = [panel for panel in shown(recording, images=1).panels if panel.title == "box, state"]
    assert panel.marks == marks


def test_a_grasp(tmp_path: Path) -> None:
    """Assert that a grasp shows goal and position, height, distance moved, phases, outcome and side view, in units."""
    path = tmp_path / "g.recording.h5"
    write_recording(path, grasp=True)
    data = shown(path)
    panels = {panel.title: panel for panel in data.panels}
    motion = panels["Gripper, goal and position (up closes)"]
    assert [line.name for line in motion.lines] == ["goal", "position"]
    assert motion.lines[0].value.tolist() == [310.0] * (SLICES // 2)
    height = panels["Object, height above the table, truth"]
    assert (height.unit, height.lines[0].value[-1]) == ("mm", pytest.approx(60.0))
    moved = panels["Object, moved in the gripper since the grip, truth"].lines[0]
    assert np.isnan(moved.value[:GRIPPED]).all()
    assert moved.value[-1] == pytest.approx(0.05 * (SLICES - 1 - GRIPPED) / 100, abs=1e-3)  # 0.05 mm a px
    assert {lane.name: lane.slip for lane in data.phases} == {
        "contact": [(0.0, 0.102)],
        "lift": [(0.102, 0.2)],
        "balance": [(0.2, 0.3)],
    }
    assert panels["Slip probability, detector while grasping"].levels == {"threshold": 0.4}
    assert data.onsets == {"truth": None, "detector": 250}  # what it says in the light contact is no slip
    assert data.contact_times["gripped"] == GRIPPED
    assert data.side is not None
    np.testing.assert_allclose(data.side["height"][[0, -1]], [60 * 4 / 299, 60.0], rtol=1e-5)
    view.run([path], View(), None)
    text = path.with_name("g.html").read_text()
    for words in ("grasp <b>held to the end", "moved <b>1.2 mm", "object&#x27;s material <b>paper"):
        assert words.replace("&#x27;", "'") in text, words
