"""view: the page that shows a trial, in a headless browser too; what it draws, decimated; hostile files."""

import base64
import html
import io
import json
import os
import re
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.events import slice_starts
from evetac_cli.inspect import view
from evetac_cli.inspect.view import lines, pictures
from evetac_cli.inspect.view import page as view_page
from evetac_cli.inspect.view.collect import collect_view
from evetac_cli.inspect.view.trial_files import open_trial
from evetac_cli.inspect.view.view_data import ViewData
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.features import event_image
from evetac_cli.params import View
from evetac_cli.store.files import write_stage
from evetac_cli.store.provenance import Header, Recipe
from evetac_cli.store.read import open_recording

SLICES = 300
ONSET = 200
WIDTH, HEIGHT = 64, 48
REST = np.stack(np.meshgrid([10.0, 25.0, 40.0], [12.0, 32.0]), axis=-1)
NASTY = "</script><script>document.title='owned'</script><!-- \"quoted\" 'single' & ünïcode \u2028"
SENSOR = {
    "sensor/frame_px": np.array([WIDTH, HEIGHT], np.int32),
    "sensor/name": "evetac",
    "sensor/dot_xy_px": REST,
    "sensor/dot_radius_px": np.float64(3.0),
    "sensor/window_px": np.array([50, 0, WIDTH, HEIGHT], np.int32),
}


def write_recording(
    path: Path, slices: int = SLICES, rate: int = 4, *, truth: bool = True, scene: str = "slip"
) -> Header:
    """A recording whose events wander over the frame, `rate` a slice."""
    rng = np.random.default_rng(5)
    t = np.repeat(np.arange(slices, dtype=np.int64) * 1000, rate)
    count = len(t)
    arrays: dict[str, Any] = {
        "events/t": t,
        "events/x": ((t // 1000 + rng.integers(0, 8, count)) % WIDTH).astype(np.uint16),
        "events/y": rng.integers(0, HEIGHT, count).astype(np.uint16),
        "events/p": rng.integers(0, 2, count).astype(np.uint8),
        "ms_to_idx": slice_starts(t, slices),
        "t_offset": np.int64(0),
        **SENSOR,
    }
    if truth:
        commands = np.arange(0, slices, 2)
        arrays |= {
            "gripper/t_us": commands * 1000,
            "gripper/current_target_ma": np.linspace(20.0, 0.0, len(commands)),
            "gripper/current_written_ma": np.zeros(len(commands), np.int32),
            "gripper/current_ma": np.linspace(20.0, 0.0, len(commands)).astype(np.float32),
            "gripper/position_ticks": np.full(len(commands), 300, np.int32),
            "truth/dot_xy_px": np.tile(REST.reshape(1, -1, 2), (slices, 1, 1)).astype(np.float32),
            "truth/object_xy_px": np.zeros((slices, 2), np.float32),
            "truth/slid_px": np.zeros(slices, np.float32),
            "truth/slip": (np.arange(slices) >= ONSET).astype(np.uint8),
            "truth/slip_fraction": np.zeros(slices, np.float32),
            "truth/normal_force_n": np.linspace(2.0, 1.0, slices).astype(np.float32),
            "truth/shear_force_n": np.ones((slices, 2), np.float32),
            "truth/sampled_parameters": "{}",
        }
    parameters = {"scene": {"name": scene, "summary": scene}, "object": 8, "sensor": "evetac", "slices": slices}
    return write_stage(path, Recipe("recording", 1, parameters, seed=1, simulated_source=truth), arrays)


def write_tracks(path: Path, parent: Header, dots: np.ndarray) -> Header:
    """Tracks of (slices, 6, 2)."""
    arrays = {
        "dot_xy_px": dots.astype(np.float32),
        "events_per_dot": np.zeros(dots.shape[:2], np.int32),
        "lost": np.zeros(dots.shape[:2], np.uint8),
        **SENSOR,
    }
    return write_stage(path, Recipe("tracks", 1, {"preset": "paper"}, parents=(parent,)), arrays)


def moving(slices: int = SLICES) -> np.ndarray:
    """Dots that go right by 4 px in all."""
    return REST.reshape(1, -1, 2) + np.linspace(0, 4, slices)[:, None, None] * np.array([1.0, 0.0])


def write_labels(path: Path, parent: Header, onset: int = ONSET + 3, slices: int = SLICES, **more: str) -> Header:
    label = np.full(slices, -1, np.int8)
    label[50:] = 0
    label[onset:] = 1
    arrays = {
        "label": label,
        "relative_flow_px": np.where(label < 0, np.nan, 0.1 + label).astype(np.float32),
        "onset_slice": np.int64(onset),
        "confidence": np.float64(1.0),
        "flow_pairs_computed": np.int64(9),
    }
    return write_stage(path, Recipe("labels", 1, {"threshold_px": 0.3, **more}, parents=(parent,)), arrays)


def write_trial(folder: Path) -> Path:
    """A recording with tracks and labels beside it."""
    path = folder / "a.recording.h5"
    header = write_recording(path)
    write_tracks(folder / "a.tracks.h5", header, moving())
    write_labels(folder / "a.labels.h5", header)
    return path


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    """A trial to be changed by a test."""
    return write_trial(tmp_path)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a trial."""
    recording = write_trial(tmp_path_factory.mktemp("page"))
    view.run([recording], View(), None)
    return recording.with_name("a.html")


def shown(path: Path, **chosen: Any) -> ViewData:
    """What would be drawn."""
    params = View(**chosen)
    with open_trial([path]) as trial:
        return collect_view(trial, params, view._span(trial, params), lambda done, total: None)


def data_of(page: Path) -> dict[str, Any]:
    """What the page's script is given."""
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


# Decimation -----------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 40_000), st.integers(0, 2**32 - 1), st.booleans())
def test_extremes_are_kept(length: int, seed: int, holes: bool) -> None:
    """Assert that decimated series are values of the series in order of time, few, and hold both extremes."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(length, 2)).astype(np.float32)
    if holes:
        rows[rng.random(rows.shape) < 0.3] = np.nan
        rows[rng.random(rows.shape) < 0.01] = np.inf
    asked: list[int] = []

    def read(start: int, stop: int) -> np.ndarray:
        asked.append(stop - start)
        return rows[start:stop]

    for column, (at, value) in zip(rows.T, lines.extremes(length, read), strict=True):
        assert len(at) == len(value) <= 2 * lines.BINS
        assert (np.diff(at) > 0).all()
        finite = np.isfinite(value)
        np.testing.assert_array_equal(value[finite], column[at][finite])
        assert not np.isfinite(column[at][~finite]).any()
        known = column[np.isfinite(column)]
        if len(known):
            assert (np.nanmin(value), np.nanmax(value)) == (known.min(), known.max())
    assert max(asked) <= lines.BLOCK_ROWS


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 20_000), st.integers(0, 2**32 - 1))
def test_no_slip_is_lost(length: int, seed: int) -> None:
    """Assert that every slice of slip lies in a stretch of slip, exactly where there are no more slices than bins."""
    rng = np.random.default_rng(seed)
    states = rng.choice(np.array([-1, 0, 1], np.int8), length, p=[0.3, 0.6, 0.1])
    states = np.repeat(states, 3)[:length]
    slip, unknown = lines.stretches(length, lambda first, last: states[first:last, None])
    covered = np.zeros(length, np.int8)
    for value, found in ((1, slip), (-1, unknown)):
        for first, last in found:
            assert first < last
            assert (covered[first:last] == 0).all()
            covered[first:last] = value
    assert (covered[states == 1] == 1).all()
    if length <= lines.BINS:
        np.testing.assert_array_equal(covered, states)


def test_a_picture_is_the_paper_s(trial: Path) -> None:
    """Assert that the PNG of a moment holds white, black and grey where the event image has +1, -1 and 0."""
    with open_recording(trial) as recording:
        png, count = pictures.picture(recording, 20, 5)
        events = recording.between(20, 25)
    levels = np.asarray(Image.open(io.BytesIO(png)).convert("L")).astype(int)
    expected = np.array(pictures.GREYS)[event_image(events.x, events.y, events.p, (WIDTH, HEIGHT)) + 1]
    np.testing.assert_array_equal(levels, expected)
    assert count == events.size == 20


def test_many_events_are_drawn_from_the_end(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that at a huge rate only the last events of a moment are read and drawn, and all are counted."""
    monkeypatch.setattr(pictures, "MOST_EVENTS", 3)
    with open_recording(trial) as recording:
        png, count = pictures.picture(recording, 20, 5)
        last = recording.between(24, 25)
    levels = np.asarray(Image.open(io.BytesIO(png)).convert("L"))
    drawn = event_image(last.x[1:], last.y[1:], last.p[1:], (WIDTH, HEIGHT))
    np.testing.assert_array_equal(levels != 128, drawn != 0)
    assert count == 20


def test_a_large_frame_is_drawn_coarsely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a frame of 65535 x 65535 px, which a file may claim, makes a picture of bounded size."""
    path = tmp_path / "a.recording.h5"
    write_recording(path, 10, truth=False)
    with open_recording(path) as recording:
        monkeypatch.setattr(type(recording), "frame_px", (65535, 65535))
        png, _ = pictures.picture(recording, 0, 5)
    assert max(Image.open(io.BytesIO(png)).size) <= pictures.LARGEST_IMAGE_PX


# What is shown --------------------------------------------------------------------------------------------------------


def test_everything_of_a_trial(trial: Path) -> None:
    """Assert that panels, lanes, onsets and dots are there, and that truth says simulated."""
    found = shown(trial)
    assert [panel.title for panel in found.panels] == [
        "Events a millisecond",
        "Gripper, current",
        "Gripper, width between the fingers",
        "Forces on one pad, truth",
        "Dots, distance from rest",
        "Flow that labels slip",
    ]
    assert [panel.simulated for panel in found.panels] == [False, True, True, True, False, False]
    events, current, _, forces, dots, flow = found.panels
    assert (events.lines[0].value == 4).all()
    assert current.lines[0].t_s[-1] == pytest.approx(0.298)
    np.testing.assert_allclose(forces.lines[1].value, np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(dots.lines[1].value, np.linspace(0, 4, SLICES), atol=1e-5)
    assert flow.levels == {"threshold": 0.3}
    assert found.onsets == {"truth": ONSET, "label": ONSET + 3}
    truth, label = found.lanes
    assert truth.slip == [(0.2, 0.3)]
    assert (label.slip, label.unknown) == ([(0.203, 0.3)], [(0.0, 0.05)])
    assert found.frame_times.tolist() == list(range(SLICES - 4))
    assert found.dot_xy_px is not None
    np.testing.assert_allclose(found.dot_xy_px, moving()[4:].astype(np.float32))


def test_images_are_bounded_and_dense_near_slip(trial: Path) -> None:
    """Assert that there are no more images than asked for, over the whole span, closest around the onsets."""
    found = shown(trial, images=60)
    assert len(found.frame_times) <= 60
    assert (found.frame_times[0], found.frame_times[-1]) == (0, SLICES - 5)
    gaps = np.diff(found.frame_times)
    assert gaps[(found.frame_times[:-1] > 192) & (found.frame_times[:-1] < 204)].max() <= 2 < gaps.max()
    assert len(shown(trial, images=1).frame_times) == 1


def test_a_part(trial: Path) -> None:
    """Assert that --start-s and --stop-s bound images and series, and that nothing is found before the start."""
    found = shown(trial, start_s=0.22, stop_s=0.25)
    assert found.span == (220, 250)
    assert (found.frame_times[0], found.frame_times[-1]) == (220, 245)
    assert all(0.22 <= t < 0.25 for panel in found.panels for line in panel.lines for t in line.t_s)
    assert found.onsets == {"truth": 220, "label": 220}
    assert shown(trial, stop_s=99.0).span == (0, SLICES)
    for wrong in ({"start_s": 0.3}, {"start_s": 0.2, "stop_s": 0.2}, {"start_s": 9.0, "stop_s": 8.0}):
        with pytest.raises(InputError, match="no time is left"):
            shown(trial, **wrong)


@pytest.mark.parametrize(("method", "levels"), [("dis", 1), ("event-flow", 0), ("truth", 0), ("<b>", 0)])
def test_labels_say_their_method(trial: Path, method: str, levels: int) -> None:
    """Assert that the method of labels is named, its threshold is drawn where it is one, and copied truth is owned."""
    with open_recording(trial) as recording:
        header = recording.header
    write_labels(trial.with_name("a.labels.h5"), header, method=method)
    found = shown(trial, images=1)
    assert found.panels[-1].title == f"Flow that labels slip, {method}"
    assert len(found.panels[-1].levels) == levels
    assert ("The labels were copied from the truth (simulated)." in found.notes) == (method == "truth")
    assert "<b>" not in view_page._head(found.panels[-1].title, "px", False, "").replace("&lt;b&gt;", "")


def test_model_output(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a model named beside features gives a series, a lane and an onset, the same in blocks as at once."""

    class Fake:
        architecture = ARCHITECTURES["hist10"]

        def over(self, series: np.ndarray, first: int) -> np.ndarray:
            mean = np.convolve(series[:, 0, 0], np.full(10, 0.1), "valid")
            return np.concatenate((np.full(min(9, len(series)), np.nan), mean)).astype(np.float32)

    monkeypatch.setattr("evetac_cli.stages.slip_detectors.load_detector", lambda model: Fake())
    displacement = np.linspace(0, 1, SLICES, dtype=np.float32)[:, None]
    features = SimpleNamespace(
        length=lambda path: SLICES,
        read=lambda path, start=0, stop=None: displacement[start:stop],
        has=lambda path: False,
    )
    model = SimpleNamespace(read=lambda path: 0.5)
    with open_trial([trial]) as real:
        real.features, real.model = features, model  # type: ignore[assignment]
        real_files = [file for file in real.files if file not in (features, model)]
        monkeypatch.setattr(type(real), "files", real_files)
        whole = collect_view(real, View(), (0, SLICES), lambda done, total: None)
        monkeypatch.setattr(lines, "BLOCK_ROWS", 7)
        part = lines.model_output(real, (40, 90))
    (panel,) = [panel for panel in whole.panels if panel.title == "Slip probability, model"]
    lane = whole.lanes[-1]
    np.testing.assert_allclose(part, panel.lines[0].value[40:90], rtol=1e-6)
    expected = int(np.flatnonzero(panel.lines[0].value >= 0.5)[0])
    assert whole.onsets["model"] == expected
    assert (lane.slip, lane.unknown) == ([(expected / 1000, 0.3)], [(0.0, 0.009)])
    assert panel.levels == {"threshold": 0.5}


# Files ----------------------------------------------------------------------------------------------------------------


def test_neighbours_are_found_from_any_file(trial: Path) -> None:
    """Assert that each file of a trial leads to the others, also to a recording of another name."""
    for kind in ("recording", "tracks", "labels"):
        with open_trial([trial.with_name(f"a.{kind}.h5")]) as found:
            assert [file.kind for file in found.files] == ["recording", "tracks", "labels"]
    trial.rename(trial.with_name("renamed.recording.h5"))
    with open_trial([trial.with_name("a.labels.h5")]) as found:
        assert found.recording is not None
        assert found.recording.path.name == "renamed.recording.h5"


def test_without_the_recording(trial: Path) -> None:
    """Assert that tracks alone show dots and their series, and say that there are no event images."""
    trial.unlink()
    found = shown(trial.with_name("a.tracks.h5"))
    assert found.pictures == []
    assert found.dot_xy_px is not None
    assert "not beside these files" in found.notes[0]
    found = shown(trial.with_name("a.labels.h5"))
    assert [panel.title for panel in found.panels][-1] == "Flow that labels slip"
    view.run([trial.with_name("a.labels.h5")], View(), None)


def test_strangers_beside_are_left_out(trial: Path, tmp_path: Path) -> None:
    """Assert that labels of another recording and truncated tracks beside a recording are left out, with a note."""
    other = write_recording(tmp_path / "b.recording.h5", scene="other")
    (tmp_path / "a.labels.h5").unlink()
    write_labels(tmp_path / "a.labels.h5", other)
    tracks = tmp_path / "a.tracks.h5"
    os.truncate(tracks, tracks.stat().st_size // 2)
    with open_trial([trial]) as found:
        assert [file.kind for file in found.files] == ["recording"]
        assert sorted(note.split(":")[1].split()[0] for note in found.notes) == ["a.labels.h5", "a.tracks.h5"]
    with pytest.raises(InputError, match="two trials"):
        view.run([trial, tmp_path / "a.labels.h5"], View(), None)
    with pytest.raises(InputError, match="truncated"):
        view.run([tracks], View(), None)
    with pytest.raises(InputError, match="two recording files"):
        shutil.copy(trial, tmp_path / "c.recording.h5")
        view.run([trial, tmp_path / "c.recording.h5"], View(), None)
    assert list(tmp_path.glob("*.html")) == []


def test_tracks_that_are_short_or_not_finite(trial: Path) -> None:
    """Assert that tracks which end early or hold NaN and infinity make a page, and that it says where they end."""
    with open_recording(trial) as recording:
        header = recording.header
    dots = moving(120)
    dots[10:20] = np.nan
    dots[30, 2] = np.inf
    dots[40, 1, 0] = -1e30
    tracks = trial.with_name("a.tracks.h5")
    tracks.unlink()
    write_tracks(tracks, header, dots)
    found = shown(trial)
    assert "tracks end at 0.120 s, 180 ms before" in found.notes[0]
    assert found.dot_xy_px is not None
    assert np.isnan(found.dot_xy_px[116:]).all()
    assert np.isfinite(found.dot_xy_px[100:116]).all()
    (panel,) = [panel for panel in found.panels if panel.title == "Dots, distance from rest"]
    assert np.isnan(panel.lines[0].value[10:20]).all()
    outcome = view.run([trial], View(film=trial.with_name("a.gif"), images=30), None)
    assert outcome.rows[0]["images"] > 10


@pytest.mark.parametrize("slices", [0, 1, 2, 7])
def test_next_to_nothing(tmp_path: Path, slices: int) -> None:
    """Assert that recordings without a slice, with one, and without events make a page; the empty one says so."""
    path = tmp_path / "a.recording.h5"
    write_recording(path, slices, rate=0, truth=False)
    outcome = view.run([path], View(), None)
    text = (tmp_path / "a.html").read_text()
    assert ("This recording is empty" in text) == (slices == 0)
    assert ("There is not one event" in text) == (slices > 0)
    assert outcome.rows[0]["images"] == min(slices, max(1, slices - 4))
    if slices == 0:
        with pytest.raises(InputError, match="nothing to animate"):
            view.run([path], View(film=tmp_path / "a.gif"), None, force=True)


def test_nothing_long_is_read_at_once(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that dots and forces, which are gigabytes in an hour, are read in blocks."""
    from evetac_cli.store.files import StageFile

    asked: dict[str, int] = {}
    read = StageFile.read

    def spy(self: StageFile, path: str, start: int = 0, stop: int | None = None) -> Any:
        value = read(self, path, start, stop)
        if np.ndim(value):
            asked[f"{self.kind} {path}"] = max(asked.get(f"{self.kind} {path}", 0), len(value))
        return value

    monkeypatch.setattr(StageFile, "read", spy)
    for name, value in {"BINS": 20, "BLOCK_ROWS": 40}.items():
        monkeypatch.setattr(lines, name, value)
    found = shown(trial, images=5)
    assert all(len(line.value) <= 40 for panel in found.panels for line in panel.lines)
    for path in ("recording truth/normal_force_n", "labels relative_flow_px", "recording gripper/current_ma"):
        assert asked[path] <= 60, path


# The page as a file ---------------------------------------------------------------------------------------------------


def evetac(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})


def test_command(trial: Path) -> None:
    """Assert that the command writes NAME.html beside the file, says so in the one shape, and keeps what exists."""
    few = ("--images", "5")
    result = evetac("view", trial, "--json", "--film", trial.with_name("film.gif"), *few)
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    (row,) = told["rows"]
    page = trial.with_name("a.html")
    assert (told["command"], told["simulated"], row["page"]) == ("view", True, str(page))
    assert row["size_bytes"] == page.stat().st_size < view_page.LARGEST_BYTES
    assert (row["images"], row["files"]) == (5, "a.recording.h5 a.tracks.h5 a.labels.h5")
    before = page.read_bytes()
    result = evetac("view", trial)
    assert result.exit_code == 2
    assert "the output exists" in result.stderr
    assert page.read_bytes() == before
    assert evetac("view", trial, "--force", "-q", "--images", "4").output == ""
    assert page.read_bytes() != before
    assert sorted(path.name for path in trial.parent.glob(".*")) == []


def test_where_the_page_goes(tmp_path: Path) -> None:
    """Assert that -o takes a file or a folder, and that the default is NAME.html beside the input."""
    (tmp_path / "dotted.d").mkdir()
    file = tmp_path / "a.b.tracks.h5"
    assert view._target(file, None) == tmp_path / "a.b.html"
    assert view._target(file, tmp_path / "new") == tmp_path / "new" / "a.b.html"
    assert view._target(file, tmp_path / "dotted.d") == tmp_path / "dotted.d" / "a.b.html"
    assert view._target(file, tmp_path / "c.HTML") == tmp_path / "c.HTML"


def test_outputs_that_are_refused(trial: Path) -> None:
    """Assert that a page never takes the place of a stage file or a folder, and that a failed write leaves nothing."""
    for flags in (["-o", trial], ["-o", trial.with_name("x.h5")], ["--film", trial.with_name("a.labels.h5")]):
        result = evetac("view", trial, "--force", *flags)
        assert result.exit_code == 2
        assert "wrong kind of output" in result.stderr
    trial.with_name("folder.html").mkdir()
    (trial.with_name("folder.html") / "a.html").mkdir()
    assert "the output is a folder" in evetac("view", trial, "-f", "-o", trial.with_name("folder.html")).stderr
    with pytest.raises(EvetacError, match="the output folder is a file"):
        view._write(trial / "below-a-file.html", b"")
    assert sorted(path.name for path in trial.parent.iterdir()) == [
        "a.labels.h5",
        "a.recording.h5",
        "a.tracks.h5",
        "folder.html",
    ]


def test_libraries_are_missed_in_words() -> None:
    """Assert that a missing library is named before any work, with how to get it."""
    with pytest.raises(EvetacError, match=r"evetac\[plot\]"):
        view._check_libraries(["no_such_library_at_all"])


def test_page_needs_no_network(page: Path) -> None:
    """Assert that the page loads nothing: no address in an attribute, and a policy that forbids it."""
    text = page.read_text()
    assert "default-src 'none'" in text
    assert re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=", text) == []
    assert "@@" not in text


def test_text_from_files_is_escaped(tmp_path: Path) -> None:
    """Assert that names and scenes which look like markup stay text."""
    path = tmp_path / "a\"'<img src=x onerror=alert(1)>@@DATA@@ü.recording.h5"
    write_recording(path, 20, scene=NASTY)
    view.run([path], View(), tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert "document.title='owned'" not in text
    assert "<img" not in text
    assert html.escape(path.name) in text
    assert len(data_of(tmp_path / "p.html")["frame_times"]) == 16


def test_page_is_bounded(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that images are thinned evenly where they would be too many bytes, with a note; else it is refused."""
    whole = shown(trial)
    size = sum(map(len, whole.pictures))
    monkeypatch.setattr(pictures, "IMAGE_BYTES", size // 3)
    found = shown(trial)
    assert sum(map(len, found.pictures)) <= size // 3
    assert found.frame_times.tolist() == whole.frame_times.tolist()[::4]
    assert "only every 4th" in found.notes[-1]
    assert len(found.events) == len(found.pictures) == len(found.frame_times)
    monkeypatch.setattr(view_page, "LARGEST_BYTES", 1_000_000)
    with pytest.raises(EvetacError, match="too large"):
        view.run([trial], View(images=1), None)


def test_page_says_what_it_shows(page: Path) -> None:
    """Assert that file, scene, object, recipe id and origin are in the page, and the data that its script draws."""
    text = page.read_text()
    with open_recording(page.with_name("a.recording.h5")) as recording:
        assert recording.header["id"] in text
    for words in (">simulated<", "scene <b>slip</b>", "object <b>8</b>", "a.tracks.h5", "0.200 s", "+3 ms"):
        assert words in text, words
    data = data_of(page)
    tracked = np.frombuffer(base64.b64decode(data["tracked"]), "<f4").reshape(-1, 6, 2)
    np.testing.assert_allclose(tracked, moving()[4:].astype(np.float32))
    assert data["onsets"] == {"truth": ONSET, "label": ONSET + 3}


def test_film(trial: Path) -> None:
    """Assert that the animation has at most 300 frames that differ, in the width promised."""
    film = trial.with_name("a.gif")
    outcome = view.run([trial], View(film=film, images=20), None)
    with Image.open(film) as image:
        assert image.size[0] == 480
        assert 2 < image.n_frames <= 20  # type: ignore[attr-defined]
        first = np.asarray(image.convert("RGB")).copy()
        image.seek(image.n_frames - 1)  # type: ignore[attr-defined]
        assert (np.asarray(image.convert("RGB")) != first).any(axis=2).mean() > 0.001
    assert outcome.rows[0]["film_bytes"] == film.stat().st_size


# In a browser ---------------------------------------------------------------------------------------------------------


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
        found = []
        for event in self.events:
            params = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown" | "Log.entryAdded":
                    found.append(params)
                case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning", "assert"):
                    found.append(params)
                case "Network.requestWillBeSent" if not params["request"]["url"].startswith(
                    ("file:", "data:", "blob:")
                ):
                    found.append(params)
        return found

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
    found = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield found
    found.close()


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
