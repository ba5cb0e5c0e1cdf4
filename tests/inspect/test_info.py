"""info: how a recording ended and what was lost, where an import comes from, and the nearest of its history."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.inspect import info
from evetac_cli.stages import train
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.trials import record
from tests import small_files
from tests.conftest import Made
from tests.make import event_arrays, events_at, run_stage


def shown(path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines that people see, without runs of blanks."""
    info.show(info.run([path]))
    return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]


def captured(path: Path, **more: Any) -> Path:
    """A recording of two silent slices from devices."""
    arrays = event_arrays(events_at([]), 2)
    arrays |= {f"capture/{name.replace('__', '/')}": value for name, value in more.items()}
    write_stage(path, Recipe("recording", 1, {}, content="0"), arrays, force=True)
    return path


def test_how_a_recording_from_devices_went(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that end, losses that are not zero, achieved rates and misses are shown."""
    path = captured(
        tmp_path / "a.recording.h5",
        ended="camera DXM00042: is no longer on the bus",
        lost__usb_errors=np.int64(2),
        lost__dropped=np.int64(0),
        lost_slices=np.array([[0, 1], [1, 2]], np.int64),
        slices_per_s=np.float64(998.5),
        slice_late_us=np.array([1.0, 667_300.0, 9e5]),
        commands_per_s=np.float64(499.5),
        command_misses=np.int64(7),
    )
    lines = shown(path, capsys)
    for line in (
        "ended camera DXM00042: is no longer on the bus",
        "lost_why usb_errors 2",
        "slices_lost 2",
        "slices_per_s 998.5",
        "slice_late_us_p99 667,300",
        "commands_per_s 499.5",
        "command_misses 7",
    ):
        assert line in lines
    assert not any("latency" in line for line in lines)
    bare = shown(captured(tmp_path / "b.recording.h5", ended="as asked"), capsys)
    assert "lost nothing" in bare and "slices_lost 0" in bare
    assert not any(line.startswith("command") for line in bare)


def test_notes_of_an_import(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that what the reader noted, what was dropped and the source are shown."""
    source = tmp_path / "a.txt"
    source.write_text("0 1 1 1\n1 9999 1 1\n")
    chosen = Record(source=source, frame_size="640x480")
    output, _ = run_stage(record, [], chosen, tmp_path / "a.recording.h5")
    lines = shown(output, capsys)
    assert "source a.txt (text)" in lines and "events_dropped 1" in lines
    assert any(line.startswith("notes 50% of the events are outside 640x480") for line in lines)


def test_history_is_the_parents_and_a_count_of_the_rest(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a grasp names its model, a model its features and a count of what lies behind; JSON keeps all."""
    (model,) = info.run([made.grasp]).rows[0]["parents"]
    froms = [line for line in shown(made.grasp, capsys) if line.startswith(("from", "behind"))]
    assert froms == [f"from model {model[:12]} method version {train.METHOD}"]
    (row,) = info.run([made.model]).rows
    lines = shown(made.model, capsys)
    assert sum(line.startswith("from features") for line in lines) == len(row["parents"])
    (behind,) = [line for line in lines if line.startswith("behind these")]
    kinds = {kind: sum(other["kind"] == kind for other in row["history"]) for kind in ("tracks", "recording")}
    assert f"{kinds['tracks']} tracks" in behind and f"{kinds['recording']} recording" in behind
    assert len(row["history"]) > 4


def test_labels_that_abstain_say_why(tmp_path: Path) -> None:
    """Assert that info of labels, and of features made from them, says that they abstain, and why."""
    of = small_files.recording(tmp_path / "a.recording.h5")
    small_files.unsure_labels(tmp_path / "a.labels.h5", of)
    (row,) = info.run([tmp_path / "a.labels.h5"]).rows
    assert (row["abstained"], row["doubt"]) == (True, "it slides slowly")
    assert row["earliest_ms"] <= row["onset_ms"] <= row["latest_ms"]
    assert row["slices_not_examined"] == row["latest_ms"] - row["earliest_ms"] + 1


def test_touch_at_a_glance(tmp_path: Path) -> None:
    """Assert contacts, extremes of touched slices with their deviations, maps and stiffness."""
    tracks = small_files.tracks(tmp_path / "a.tracks.h5", small_files.recording(tmp_path / "a.recording.h5"))
    arrays = small_files.touch_arrays()
    touches = np.zeros(small_files.SLICES, np.uint8)
    touches[3:9] = touches[12:] = 1
    arrays["touches"] = touches
    arrays["normal_n"][[1, 5]] = 9.0, 4.0  # the first without a touch
    arrays["normal_sd_n"][5] = 0.5
    arrays["shear_n"][13] = 3.0, -4.0
    arrays["shear_sd_n"][13] = 0.3, 0.2
    arrays["torsion_n_mm"][7] = -6.0
    arrays["sticking_share"][:3] = np.nan
    arrays["sticking_share"][20], arrays["sticking_share_sd"][20] = 0.25, 0.125
    known = {"known": {"shear_modulus_pa": 9e4}, "stiffness_error": 0.1}
    path = tmp_path / "a.touch.h5"
    for parameters, stiffness in ((known, "known, 90 kPa within 10 %"), ({}, "not known")):
        write_stage(path, Recipe("touch", 1, parameters, parents=(tracks,)), arrays, force=True)
        (row,) = info.run([path]).rows
        assert row["stiffness"] == stiffness
    assert (row["contacts"], row["contact_s"], row["first_contact_ms"]) == (2, 0.018, 3)
    assert (row["normal_n_most"], row["normal_n_most_sd"]) == (4.0, 0.5)
    assert (row["shear_n_most"], row["shear_n_most_sd"]) == (5.0, pytest.approx(0.3))
    assert row["torsion_n_mm_most"] == 6.0
    assert (row["sticking_share_least"], row["sticking_share_least_sd"]) == (0.25, 0.125)
    assert row["maps"] == "2 of 5 x 4 cells of 1 mm, every 23 ms"


def test_touch_without_one(tmp_path: Path) -> None:
    """Assert that a touch file in which nothing touches and nothing is known has no extremes, and no complaint."""
    tracks = small_files.tracks(tmp_path / "a.tracks.h5", small_files.recording(tmp_path / "a.recording.h5"))
    arrays = small_files.touch_arrays()
    for name, values in arrays.items():
        if values.dtype == np.float32:
            values[...] = np.nan
        elif name in ("known", "touches"):
            values[...] = 0
    maps = {name: values for name, values in arrays.items() if not name.startswith("map/")}
    path = tmp_path / "a.touch.h5"
    write_stage(path, Recipe("touch", 1, {}, parents=(tracks,)), maps, force=True)
    (row,) = info.run([path]).rows
    assert (row["contacts"], row["slices_unknown"], row["maps"]) == (0, small_files.SLICES, "none")
    assert {row[f"{name}_most"] for name in ("shear_n", "normal_n", "torsion_n_mm", "area_mm2")} == {None}


SUMMARIES = {
    "no JSON": "{",
    "nested in a table": '{"a": ' + "[" * 500 + "]" * 500 + "}",
    "names of our own": '{"made": 3, "history": 4, "parents": 5, "simulated": "no", "file": 6, "parameters": 7}',
}


@pytest.mark.parametrize("summary", SUMMARIES.values(), ids=SUMMARIES)
def test_m4_info_of_a_report_with_any_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str], summary: str) -> None:
    """Assert that the text of a report is shown or refused in words, and never stands in for what info says itself."""
    path = tmp_path / "a.slip.report.h5"
    with small_files.nonsense_is_written():
        write_stage(path, Recipe("report", 1, {}), {"command": "evaluate slip", "rows": "[]", "summary": summary})
    try:
        lines = shown(path, capsys)
    except InputError as error:
        assert str(path) in str(error)
        assert len(str(error)) < 2_000
    else:
        assert lines[0] == str(path)


@pytest.mark.parametrize(
    "parameters",
    [
        {"notes": [1, None], "format": "text"},
        {"notes": ["a"], "format": "text", "source": "a", "dropped": {"a": "b"}},
    ],
)
def test_m4_info_of_an_import_with_any_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], parameters: dict[str, Any]
) -> None:
    """Assert that parameters of other types than an import writes are refused in words."""
    path = captured(tmp_path / "a.recording.h5", ended="as asked")
    header = Recipe("recording", 1, parameters, content="0").header()
    with h5py.File(path, "r+") as h5:
        h5.attrs["header"] = json.dumps(header)
    with pytest.raises(InputError, match="recording"):
        shown(path, capsys)


@pytest.mark.parametrize(("nodes", "warned"), [(None, False), (6.0, False), (2.5, True)])
def test_a_grid_that_is_too_coarse_for_its_slip(
    nodes: float | None, warned: bool, made: Made, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a recording's fewest nodes are shown where slip is unstable, and that too few are warned of."""
    monkeypatch.setattr(info.slip_grid, "nodes_of", lambda recording: nodes)
    lines = shown(made.recordings[0], capsys)
    assert (f"slip_half_wavelength_nodes {nodes:g}" in lines) if nodes else not any("nodes" in line for line in lines)
    said = [line for line in lines if line.startswith("warning onset of slip depends on the gel's grid")]
    assert len(said) == warned
    assert all("--node-pitch-mm" in line for line in said)
