"""The stage label: its methods, what it refuses, and what evaluate labels says of it."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels import measure as evaluate_labels
from evetac_cli.events import Events, empty
from evetac_cli.inspect import validate
from evetac_cli.kernels.labelling import flow
from evetac_cli.stages import label, label_methods
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe, content_digest
from evetac_cli.store.recordings.read import open_recording, ramp_start
from tests.conftest import Made
from tests.make import event_arrays, run_stage, write_recording

METHODS = ("event-flow", "farneback", "dis", "event-count", "truth")


def flow_constants(**changes: Any) -> flow.FlowConstants:
    """The constants of the stage's method `farneback` with some changes."""
    names = flow.FlowConstants.__dataclass_fields__
    default = {name: value for name, value in recipe_of(Label(method="farneback")).items() if name in names}
    return flow.FlowConstants(**{**default, **changes})


def label_of(recording: Path, out: Path, **chosen: Any) -> tuple[Path, dict[str, Any]]:
    """The labels of a recording, and their row."""
    output, outcome = run_stage(label, [recording], Label(after_ms=15, **chosen), out)
    return output, outcome.rows[0]


def recording_of(
    path: Path,
    events: Events,
    slices: int,
    *,
    window: bool = True,
    dots: bool = True,
) -> Path:
    """A recording without truth or gripper, of one dot."""
    content = event_arrays(events, slices)
    if window:
        content["sensor/window_px"] = np.array([540, 0, 640, 480], np.int32)
    if dots:
        content |= {"sensor/dot_xy_px": np.full((1, 1, 2), 200.0), "sensor/dot_radius_px": np.float64(15.0)}
    return write_recording(path, content)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_makes_valid_labels_that_name_it(made: Made, tmp_path: Path, method: str) -> None:
    """Assert that each method's labels are valid, are those of a slice-by-slice rule, and name it in their header."""
    output, row = label_of(made.recordings[0], tmp_path, method=method)
    assert row["method"] == method
    assert [result["faults"] for result in validate.run([output]).rows] == [None]
    with StageFile(output, "labels") as file:
        assert file.header["parameters"]["method"] == method
        onset = int(file.read("onset_slice"))
        assert row["onset_ms"] == (onset if onset >= 0 else None)
        assert onset < 0 or file.read("label")[onset] == (-1 if row["abstained"] else 1)
        assert onset < 0 or row["earliest_ms"] <= onset <= row["latest_ms"]


def test_truth_is_what_the_simulation_knows(made: Made, tmp_path: Path) -> None:
    """Assert that labels from truth are the truth from the ramp's start up to 15 ms after its onset."""
    output, row = label_of(made.recordings[0], tmp_path, method="truth")
    with StageFile(output) as labels, open_recording(made.recordings[0]) as recording:
        slips = recording.read("truth/slip")
        onset = int(np.flatnonzero(slips)[0])
        start = ramp_start(recording)
        assert 0 < start < onset
        assert (labels.read("label")[:start] == -1).all()
        np.testing.assert_array_equal(labels.read("label")[start : onset + 15], slips[start : onset + 15])
        assert (labels.read("label")[onset + 15 :] == -1).all()
    assert row["onset_ms"] == onset


def test_truth_from_the_first_slice(made: Made, tmp_path: Path) -> None:
    """Assert that --from-start labels holding and loading as no slip, and that other methods refuse it."""
    beside = tmp_path / made.recordings[0].name
    beside.write_bytes(made.recordings[0].read_bytes())
    with open_recording(beside) as recording:
        slips = recording.read("truth/slip")
        onset = int(np.flatnonzero(slips)[0])
        early = ramp_start(recording) - 5
    with h5py.File(beside, "a") as file:
        file["truth/slip"][early] = 1  # slides a little while it is loaded: left out
    output, row = label_of(beside, tmp_path, method="truth", from_start=True)
    with StageFile(output) as labels:
        expected = slips[: onset + 15].astype(int)
        expected[early] = -1
        np.testing.assert_array_equal(labels.read("label")[: onset + 15], expected)
    assert row["onset_ms"] == onset
    with pytest.raises(InputError, match="--from-start"):
        label_of(made.recordings[0], tmp_path / "other", method="event-flow", from_start=True)


def test_slip_before_the_ramp_is_no_onset(made: Made, tmp_path: Path) -> None:
    """Assert that an object which slips while its weight is handed over has the onset that its ramp gives it."""
    beside = tmp_path / made.recordings[0].name
    beside.write_bytes(made.recordings[0].read_bytes())
    with open_recording(beside) as recording:
        onset = int(np.flatnonzero(recording.read("truth/slip"))[0])
        early = ramp_start(recording) - 5
    with h5py.File(beside, "a") as file:
        file["truth/slip"][early] = 1
        file["truth/every_node_slid_px"][early] = 1.0
    output, row = label_of(beside, tmp_path, method="truth")
    assert row["onset_ms"] == onset
    (evaluated,) = run_stage(evaluate_labels, [output], EvaluateLabels(), tmp_path)[1].rows
    assert evaluated["t_s_ms"] == onset
    assert evaluated["t_every_node_ms"] >= onset


def test_reports_name_labels_from_truth(made: Made, tmp_path: Path) -> None:
    """Assert that a report on labels from truth says so in its summary and carries it in its history."""
    beside = tmp_path / made.recordings[0].name
    beside.write_bytes(made.recordings[0].read_bytes())
    output, _ = label_of(beside, tmp_path, method="truth")
    (job,) = evaluate_labels.jobs([output], EvaluateLabels(), tmp_path)
    outcome = evaluate_labels.run(job, EvaluateLabels())
    assert outcome.summary["method"] == "truth"
    assert outcome.summary["onset_error_ms_median"] == 0
    assert outcome.summary["within_minus4_plus3_ms"] == 1
    (row,) = outcome.rows
    assert row["gross_slip_start_ms"] <= row["t_s_ms"] <= row["t_every_node_ms"]
    later_ms = row["t_every_node_ms"] - row["t_s_ms"]
    assert outcome.summary["every_node_after_t_s_ms_median"] == later_ms
    assert outcome.summary["every_node_after_t_s_ms_most"] == later_ms
    with StageFile(job.output) as report:
        (parent,) = report.header["parents"]
        assert report.header["history"][parent]["parameters"]["method"] == "truth"


def test_an_onset_that_was_missed_counts_against(made: Made, tmp_path: Path) -> None:
    """Assert that a slip without an onset in the labels lowers the share within the limits."""
    beside = tmp_path / made.recordings[0].name
    beside.write_bytes(made.recordings[0].read_bytes())
    output, row = label_of(beside, tmp_path, method="event-count", threshold_events=10**6)
    assert row["onset_ms"] is None
    summary = run_stage(evaluate_labels, [output], EvaluateLabels(), tmp_path)[1].summary
    assert summary["onsets_found"] == 0
    assert summary["within_minus4_plus3_ms"] == 0


def test_the_default_finds_the_onset(made: Made, tmp_path: Path) -> None:
    """Assert that event-flow finds the onset of every short trial within 10 ms (its gel is coarse, and fast)."""
    for recording in made.recordings:
        _, row = label_of(recording, tmp_path)
        with open_recording(recording) as file:
            true = int(np.flatnonzero(file.read("truth/slip"))[0])
        assert abs(row["onset_ms"] - true) <= 10


@pytest.mark.parametrize("method", METHODS[:-1])
def test_without_a_window_it_says_so(tmp_path: Path, method: str) -> None:
    """Assert that a gel without window is refused in words, and nothing is written."""
    path = recording_of(tmp_path / "a.recording.h5", empty(), 50, window=False)
    with pytest.raises(InputError, match="the gel has no window"):
        label_of(path, tmp_path, method=method)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("method", ["event-flow", "farneback", "dis"])
def test_without_texture_it_says_so(tmp_path: Path, method: str) -> None:
    """Assert that a window that shows nothing while the gel is dragged is refused in words."""
    rng = np.random.default_rng(0)
    t, x, y, p = [], [], [], []
    for slice_ in range(400):
        angle = rng.uniform(0, 2 * np.pi, 650)
        seen = np.abs(np.cos(angle)) * 0.02 * 650 > rng.uniform(0, 650 / 50, 650)
        angle = angle[seen]
        t += [slice_ * 1000] * len(angle)
        x += list(np.round(200 + 0.02 * slice_ + 15 * np.cos(angle)))
        y += list(np.round(200 + 15 * np.sin(angle)))
        p += list(np.cos(angle) < 0)
    events = Events(np.array(t), np.array(x, np.uint16), np.array(y, np.uint16), np.array(p, np.uint8))
    path = recording_of(tmp_path / "a.recording.h5", events, 400)
    with pytest.raises(InputError, match=r"slip cannot be labelled: texture(.|\n)*try: "):
        label_of(path, tmp_path, method=method)


def test_event_flow_needs_dots_and_truth_needs_truth(tmp_path: Path) -> None:
    """Assert that what a method needs and the recording lacks is named, with another method to try."""
    path = recording_of(tmp_path / "a.recording.h5", empty(), 50, dots=False)
    with pytest.raises(InputError, match=r"no dot grid(.|\n)*--method farneback"):
        label_of(path, tmp_path)
    with pytest.raises(InputError, match=r"no truth(.|\n)*another --method"):
        label_of(path, tmp_path, method="truth")
    assert label_of(path, tmp_path, method="farneback")[1]["onset_ms"] is None


WAYS = {  # how a sensor can be mounted: places and size of the frame from those of an upright one
    "turned by 180 degrees": (lambda x, y: (639 - x, 479 - y), (640, 480)),
    "mirrored left to right": (lambda x, y: (639 - x, y), (640, 480)),
    "mirrored top to bottom": (lambda x, y: (x, 479 - y), (640, 480)),
    "turned clockwise": (lambda x, y: (479 - y, x), (480, 640)),
    "turned anticlockwise": (lambda x, y: (y, 639 - x), (480, 640)),
}


@pytest.mark.parametrize("mounting", WAYS)
def test_an_onset_does_not_depend_on_the_mounting(made: Made, tmp_path: Path, mounting: str) -> None:
    """Assert that a recording is labelled alike wherever in the frame its window is."""
    place, frame_px = WAYS[mounting]
    with open_recording(made.recordings[0]) as upright:
        expected = label_methods.compute(upright, Label(after_ms=15))
        window, gel = label_methods.regions(upright)
        events = upright.between(0, len(upright))
        content: dict[str, Any] = {f"events/{name}": getattr(events, name) for name in Events._fields}
        x, y = place(events.x.astype(np.int64), events.y.astype(np.int64))
        corners = np.array([place(540, 0), place(639, 479)])
        dots = np.stack(place(upright.dot_xy_px[..., 0], upright.dot_xy_px[..., 1]), axis=-1)  # type: ignore[index]
        content |= {
            "events/x": x.astype(np.uint16),
            "events/y": y.astype(np.uint16),
            "ms_to_idx": upright.starts,
            "t_offset": np.int64(0),
            "sensor/frame_px": np.array(frame_px, np.int32),
            "sensor/name": "unknown",
            "sensor/window_px": np.concatenate([corners.min(axis=0), corners.max(axis=0) + 1]).astype(np.int32),
            "sensor/dot_xy_px": dots.reshape(1, -1, 2),
            "sensor/dot_radius_px": upright.read("sensor/dot_radius_px"),
        }
        start = ramp_start(upright)
    path = tmp_path / "mounted.recording.h5"
    write_stage(path, Recipe("recording", 1, {}, content=content_digest(content)), content)
    with open_recording(path) as mounted:
        regions = label_methods.regions(mounted)
        assert expected.onset > 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(label_methods, "ramp_start", lambda recording: start)
            assert label_methods.compute(mounted, Label(after_ms=15)).onset == expected.onset
    assert [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in regions] == [
        (x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in (window, gel)
    ]


@pytest.mark.slow
def test_leaving_out_does_not_change_the_onset(made: Made) -> None:
    """Assert that steps, leaving out pairs, and smaller pictures give the onset that all pairs of all slices give."""
    with open_recording(made.recordings[0]) as recording:
        true = int(np.flatnonzero(recording.read("truth/slip"))[0])
        window, gel = label_methods.regions(recording)
        result = [
            flow.label(recording.between, true + 12, window, gel, constants, true - 20)
            for constants in (
                flow_constants(coarse_ms=1, plain=True, after_ms=0),
                flow_constants(coarse_ms=1, clear_px=np.inf, after_ms=0),
                flow_constants(coarse_ms=3, clear_px=np.inf, after_ms=0),
                flow_constants(coarse_ms=5, after_ms=0),
            )
        ]
    assert len({labels.onset for labels in result}) == 1
    assert result[-1].flow_pairs < result[0].flow_pairs
