"""Contents that make no sense, one for each rule of each kind of file: `validate` names the dataset, stages refuse.

Every change is a dataset of the right dtype and shape, so that nothing but its values is wrong.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.label import Label
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.track import Track
from evetac_cli.commands.trim import Trim
from evetac_cli.errors import InputError
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels import measure as evaluate_labels
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as evaluate_slip
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as evaluate_tracking
from evetac_cli.inspect import validate
from evetac_cli.stages import featurize, label, track, trim
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.files import StageFile, put_header
from evetac_cli.store.layout.provenance import recompute_id
from tests import small_files
from tests.make import run_stage
from tests.small_files import COLUMNS, DOTS, ROWS, SLICES

NAN, INF = float("nan"), float("inf")
DEEP = "[" * 100_000 + "]" * 100_000


class Change(NamedTuple):
    """One senseless content: a value set at an index of a dataset (... for all of it), and what must be said of it."""

    kind: str
    dataset: str
    index: Any
    value: Any
    said: str

    def apply(self, path: Path) -> None:
        """Set the value in a file; text, and arrays of another shape, replace the dataset."""
        with h5py.File(path, "r+") as h5:
            stored = h5[self.dataset]
            if isinstance(self.value, str):
                del h5[self.dataset]
                h5.create_dataset(self.dataset, data=self.value, dtype=h5py.string_dtype())
            elif self.index is None:
                dtype = stored.dtype
                del h5[self.dataset]
                h5[self.dataset] = np.asarray(self.value, dtype)
                small_files.remove_dimensions(h5)
            else:
                stored[self.index] = self.value


in_recording, tracks, labels, features, model, force_model = (
    partial(Change, kind) for kind in ("recording", "tracks", "labels", "features", "model", "force-model")
)


GRID_OF_TWO_ROWS = small_files.GRID_PX[:2]

CHANGES = [
    in_recording("events/t", 0, -1, "0 or more"),
    in_recording("events/t", -1, 10**9, "ms_to_idx"),
    in_recording("events/t", 5, 900, "never decreasing"),
    in_recording("events/x", 3, 640, "inside the frame"),
    in_recording("events/p", 3, 2, "one of 0, 1"),
    in_recording("ms_to_idx", 0, 1, "begins at 0"),
    in_recording("ms_to_idx", -1, 10**6, "events/t"),
    in_recording("t_offset", (), 2**63 - 1, "4611686018427387904"),
    in_recording("sensor/frame_px", 0, 0, "1 to 65535"),
    in_recording("sensor/dot_xy_px", (0, 0), INF, "finite"),
    in_recording("sensor/dot_xy_px", ..., NAN, "at least one dot"),
    in_recording("sensor/dot_xy_px", (0, 0, 1), NAN, "both coordinates"),
    in_recording("sensor/dot_xy_px", None, GRID_OF_TWO_ROWS, "truth/dot_xy_px"),
    in_recording("sensor/dot_radius_px", (), 0.0, "more than 0"),
    in_recording("sensor/dot_radius_px", (), 1e9, "frame"),
    in_recording("capture/lost_slices", 0, [4, 4], "end after they begin"),
    in_recording("truth/slip_share", 3, 1.5, "0 to 1"),
    in_recording("truth/sampled_parameters", (), "no JSON", "a JSON object"),
    in_recording("truth/sampled_parameters", (), DEEP, "a JSON object"),
    tracks("dot_xy_px", (2, 1), 1e7, "inside the frame"),
    tracks("dot_xy_px", (2, 1), NAN, "missing in the grid"),
    tracks("sensor/dot_xy_px", None, GRID_OF_TWO_ROWS, "dot_xy_px"),
    labels("label", 3, 5, "one of -1, 0, 1"),
    labels("label", 3, 1, "onset_slice"),
    labels("onset_slice", (), -2, "-1 to"),
    labels("confidence", (), -INF, "finite"),
    features("displacement_px", (0, 0), -1.0, "0 to 100000"),
    features("label", 0, 1, "onset_slice"),
    features("onset_slice", (), SLICES, "-1 to"),
    features("dot_shape", ..., [0, 12], "1 or more"),
    features("dot_shape", ..., [COLUMNS + 1, ROWS], f"{DOTS} dots"),
    features("image/start", 3, 2, "never decreasing"),
    features("image/start", -1, 50, "image/pixel"),
    features("image/pixel", 0, 540 * 480, "0 to 259199"),
    model("history", (), -10, "history"),
    model("history", (), 11, "that of the architecture load-path"),
    model("architecture", (), "hist1000", "one of no-hist, hist10"),
    model("checkpoint/chosen", (), 99, "checkpoint/step"),
    model("checkpoint/step", 1, 0, "increasing"),
    model("weights/first.bias", 0, 100.0, "onnx"),
    model("weights/first.weight", None, np.zeros((2, 2)), "shape"),
    model("checkpoint/onnx", (0, ...), 0, "checkpoint/onnx"),
    force_model("sensor", (), "radar", "one of events, frames"),
    force_model("dot_shape", ..., [ROWS, COLUMNS + 1], "network/0/weight"),
    force_model("curve/chosen", (), 99, "curve/learned_n"),
    Change("touch", "normal_n", 0, INF, "finite"),
    Change("touch", "slip_direction_rad", 0, 4.0, "-3.1416 to 3.1416"),
    Change("touch", "reference_slice", 0, SLICES, "an index of known"),
    Change("touch", "map/slice", 1, 0, "strictly increasing"),
    Change("report", "rows", (), "no JSON", "a JSON list of flat objects"),
    in_recording("streams/arm/about", (), '{"units": {"x_m": 3}}', "`units` that are texts"),
    Change("report", "summary", (), "[]", "a JSON object"),
]


def name_of(change: Change) -> str:
    value = (
        np.array2string(np.asarray(change.value), threshold=4) if not isinstance(change.value, str) else change.value
    )
    return f"{change.kind} {change.dataset} {str(change.index)[:12]} {value[:20]}".replace("\n", "")


@pytest.fixture
def small(tmp_path: Path) -> dict[str, Path]:
    """Kind -> a small valid file, all of one trial."""
    return small_files.every_kind(tmp_path)


def test_the_files_are_valid(small: dict[str, Path]) -> None:
    """Assert that the files into which senseless contents are set are valid."""
    rows = validate.run(list(small.values())).rows
    assert [row["faults"] for row in rows] == [None] * len(small)


@pytest.mark.parametrize("change", CHANGES, ids=name_of)
def test_m3_validate_refuses_senseless_contents(change: Change, small: dict[str, Path]) -> None:
    """Assert that validate refuses the content in words that name the dataset and say what was expected."""
    path = small[change.kind]
    change.apply(path)
    (row,) = validate.run([path]).rows
    assert row["valid"] is False
    assert change.dataset.split("/")[0] in row["faults"]
    assert change.said in row["faults"]
    assert len(row["faults"]) < 2000


def outcome_of(stage: Any, chosen: Any, path: Path) -> Any:
    """Run a stage on a file, its output in a folder of its own."""
    out = path.parent / "out"
    out.mkdir(exist_ok=True)
    return run_stage(stage, [path], chosen, out)[1]


STAGES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "trim": ("recording", lambda path: outcome_of(trim, Trim(), path)),
    "track": ("recording", lambda path: outcome_of(track, Track(), path)),
    "label truth": ("recording", lambda path: outcome_of(label, Label(method="truth"), path)),
    "track --rgb": ("recording", lambda path: outcome_of(track, Track(rgb=True), path)),
    "featurize": (
        "recording",
        lambda path: outcome_of(featurize, Featurize(tracks=path.parent, labels=path.parent), path),
    ),
    "evaluate labels": ("labels", lambda path: outcome_of(evaluate_labels, EvaluateLabels(), path)),
    "evaluate tracking": ("tracks", lambda path: outcome_of(evaluate_tracking, EvaluateTracking(), path)),
    "evaluate slip": (
        "features",
        lambda path: outcome_of(evaluate_slip, EvaluateSlip(model=path.with_name("a.model.h5")), path),
    ),
    "predict-touch": ("tracks", lambda path: outcome_of(predict_touch, PredictTouch(), path)),
}

REFUSED_BY = [
    ("trim", in_recording("events/x", 3, 640, "events/x")),
    ("track", in_recording("events/p", 3, 2, "events/p")),
    ("label truth", in_recording("truth/slip", 3, 7, "truth/slip")),
    ("track --rgb", in_recording("truth/dot_xy_px", (0, 0), INF, "truth/dot_xy_px")),
    ("featurize", tracks("dot_xy_px", (2, 1), INF, "dot_xy_px")),
    ("featurize", labels("label", 3, 5, "label")),
    ("evaluate labels", labels("label", 3, 5, "label")),
    ("evaluate labels", in_recording("truth/slip", 3, 7, "truth/slip")),
    ("evaluate tracking", tracks("dot_xy_px", (2, 1), INF, "dot_xy_px")),
    ("evaluate tracking", in_recording("truth/dot_xy_px", (0, 0), NAN, "truth/dot_xy_px")),
    ("evaluate slip", model("threshold", (), 2.0, "threshold")),
    ("predict-touch", tracks("dot_xy_px", (2, 1), INF, "dot_xy_px")),
]  # fmt: skip


@pytest.mark.parametrize(("stage", "change"), REFUSED_BY, ids=[f"{s}: {name_of(c)}" for s, c in REFUSED_BY])
def test_m3_stages_refuse_what_validate_refuses(stage: str, change: Change, small: dict[str, Path]) -> None:
    """Assert that a stage that reads the content refuses it in words that name the dataset, and writes nothing."""
    change.apply(small[change.kind])
    kind, work = STAGES[stage]
    with pytest.raises(InputError, match=change.said) as refused:
        work(small[kind])
    assert str(small[change.kind]) in str(refused.value)
    assert list((small[kind].parent / "out").iterdir()) == []


def rewrite_header(path: Path, **changes: Any) -> None:
    """Change a header and give it the id that fits it, as somebody who means to deceive would."""
    with StageFile(path) as file:
        header = {**file.header, **changes}
    header["id"] = recompute_id(header)
    with h5py.File(path, "r+") as h5:
        del h5.attrs["header"]
        put_header(h5, header)


def without(small: dict[str, Path], kind: str, slices: int) -> None:
    """Cut the last slices off a file of tracks or labels, as somebody may who edits it."""
    with h5py.File(small[kind], "r+") as h5:
        for name in ("dot_xy_px", "events_per_dot", "lost", "label", "relative_flow_px"):
            if name in h5:
                rows = h5[name][:-slices]
                del h5[name]
                h5[name] = rows


@pytest.mark.parametrize("kind", ["tracks", "labels"])
def test_m4_featurize_with_fewer_slices_than_the_recording(kind: str, small: dict[str, Path]) -> None:
    """Assert that tracks and labels that are shorter than their recording are refused in words."""
    without(small, kind, 4)
    with pytest.raises(InputError, match="slices") as refused:
        STAGES["featurize"][1](small["recording"])
    assert str(small[kind]) in str(refused.value)


def test_m4_evaluate_tracking_with_fewer_slices_than_the_truth(small: dict[str, Path]) -> None:
    """Assert that tracks that are shorter than the truth beside them are refused in words."""
    without(small, "tracks", 4)
    with pytest.raises(InputError, match="slices"):
        STAGES["evaluate tracking"][1](small["tracks"])


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_m4_stages_of_files_without_slices(stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a trial without a single slice is valid, and that each stage takes or refuses it in words."""
    monkeypatch.setattr(small_files, "SLICES", 0)
    monkeypatch.setattr(small_files, "ONSET", -1)
    small = small_files.every_kind(tmp_path, lost_slices=False)
    assert [row["faults"] for row in validate.run(list(small.values())).rows] == [None] * len(small)
    kind, work = STAGES[stage]
    try:
        made = work(small[kind])
    except InputError:
        return
    written = [path for row in made.rows if (path := Path(str(row.get("output", "")))).suffix == ".h5"]
    assert [row["faults"] for row in validate.run(written).rows] == [None] * len(written)


def test_m4_evaluate_tracking_of_tracks_from_frames(small: dict[str, Path]) -> None:
    """Assert that tracks of an RGB sensor, which have the constants of a camera and not of a tracker, are evaluated."""
    rewrite_header(small["tracks"], parameters={"preset": "rgb", "camera": {"frame_ms": 40}, "seed": 0})
    made = STAGES["evaluate tracking"][1](small["tracks"])
    assert made.rows[0]["preset"] == "rgb"


def test_m4_evaluate_tracking_with_the_truth_of_another_grid(small: dict[str, Path]) -> None:
    """Assert that tracks by another grid than that of the truth are refused in words."""
    with h5py.File(small["tracks"], "r+") as h5:
        for name, rows in {name: h5[name][:, :8] for name in ("dot_xy_px", "events_per_dot", "lost")}.items():
            del h5[name]
            h5[name] = rows
        del h5["sensor/dot_xy_px"]
        h5["sensor/dot_xy_px"] = GRID_OF_TWO_ROWS
        small_files.remove_dimensions(h5)
    assert validate.run([small["tracks"]]).summary["invalid"] == 0
    with pytest.raises(InputError, match="number of dots"):
        STAGES["evaluate tracking"][1](small["tracks"])
