"""cut: a piece of a recording is a recording, and what is computed from its beginning is what was computed before."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.commands.trim import Trim
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.inspect import validate
from evetac_cli.kernels.noise_filter import NoiseFilter
from evetac_cli.stages import featurize, track, trim
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.segments import RecordingWriter
from tests.conftest import Made
from tests.inspect.test_repair import control
from tests.make import event_arrays, run_stage, write_recording
from tests.store.recordings.test_recovery import STATIC, events_of


def piece(path: Path, out: Path, **flags: Any) -> Path:
    """Cut one recording."""
    params = Trim(**flags)
    output, _ = run_stage(trim, [path], params, out)
    assert validate.run([output]).rows[0]["faults"] is None
    return output


def rich_recording(path: Path, slices: int = 12) -> Path:
    """A recording with gripper, controller and lost slices."""
    writer = RecordingWriter(path, STATIC)
    names = ("current_target_ma", "current_written_ma", "current_ma", "position_ticks")
    for k in range(slices):
        rows = {"gripper/t_us": 1000 * k + 500, **{f"gripper/{name}": k for name in names}} if k % 2 else {}
        times = {"control/t_us": 1000 * k} if k % 2 == 0 else {}
        writer.append(events_of(k, 0 if 3 <= k < 6 else 2), {"control/probability": k / 20} | control(k) | rows | times)
    lost = {"capture/ended": "after the seconds asked for", "capture/lost_slices": np.array([[3, 6]], np.int64)}
    lost["capture/lost/camera.late_events"] = np.int64(4)
    writer.finish(Recipe("recording", 1, {}), lost)
    return path


def test_every_group_is_cut(tmp_path: Path) -> None:
    """Assert that slices, commands, controller steps and gaps are those of the range, in times of their own."""
    whole = rich_recording(tmp_path / "a.recording.h5")
    with open_recording(piece(whole, tmp_path, from_ms=4, to_ms=9)) as part, open_recording(whole) as source:
        assert len(part) == 5
        for k in range(5):
            assert (part[k].t == source[k + 4].t - 4 * SLICE_US).all()
            assert (part[k].x == source[k + 4].x).all()
        assert part.read("t_offset") == source.read("t_offset") + 4 * SLICE_US
        assert part.read("gripper/t_us").tolist() == [1500, 3500]
        assert part.read("gripper/position_ticks").tolist() == [5, 7]
        assert part.read("control/t_us").tolist() == [0, 2000, 4000]
        np.testing.assert_allclose(part.read("control/probability"), np.arange(4, 9) / 20, rtol=1e-6)
        assert part.read("capture/lost_slices").tolist() == [[0, 2]]
        assert not part.has("capture/lost")
        assert part.header["parents"] == [source.header["id"]]
        assert part.header["parameters"]["trimmed"] == {"from_ms": 4, "to_ms": 9}
    with open_recording(piece(whole, tmp_path, from_ms=6, to_ms=9)) as part:
        assert not part.has("capture/lost_slices")


def test_every_dataset_of_a_simulation_is_cut(made: Made, tmp_path: Path) -> None:
    """Assert that a piece has every dataset that the whole has, cut along its slices, its events or its commands."""
    with (
        open_recording(piece(made.grasp, tmp_path, from_ms=100, to_ms=300)) as part,
        open_recording(made.grasp) as whole,
    ):
        assert part.contents().keys() == whole.contents().keys()
        table = schema.load("recording")
        for name in whole.contents():
            described = table.find(name)
            assert described is not None
            if described.dims and described.dims[0] == "slices":
                np.testing.assert_array_equal(part.read(name), whole.read(name, 100, 300))
            if described.dims == () or name.startswith("sensor/"):
                same = part.read(name) == whole.read(name)
                assert np.all(same) == (name != "t_offset")
        assert part.header["parameters"]["object"] == whole.header["parameters"]["object"]


@given(st.lists(st.integers(1, 11), min_size=0, max_size=4, unique=True))
@settings(max_examples=10, deadline=None)
@pytest.mark.slow
def test_pieces_put_together_are_the_whole(tmp_path_factory: pytest.TempPathFactory, edges: list[int]) -> None:
    """Assert that however it is cut, no event and no command is lost or doubled."""
    folder = tmp_path_factory.mktemp("cut")
    whole = rich_recording(folder / "a.recording.h5")
    bounds = [0, *sorted(edges), 12]
    events, commands = [], []
    for first, end in zip(bounds, bounds[1:], strict=False):
        with open_recording(piece(whole, folder, from_ms=first, to_ms=end)) as part:
            events += (part.between(0, len(part)).t + first * SLICE_US).tolist()
            commands += (part.read("gripper/t_us") + first * SLICE_US).tolist()
    with open_recording(whole) as source:
        assert events == source.between(0, 12).t.tolist()
        assert commands == source.read("gripper/t_us").tolist()


def test_features_of_a_beginning_are_those_of_the_whole(made: Made, tmp_path: Path) -> None:
    """Assert that tracks and features of a piece from 0 on are the first rows of the whole's, bit for bit."""
    source = made.recordings[0]
    part = piece(source, tmp_path / "a.recording.h5", to_ms=250)
    for stage, params, kind in ((track, Track(), "tracks"), (featurize, Featurize(), "features")):
        output, _ = run_stage(stage, [part], params)
        compared = 0
        with StageFile(output) as ours, StageFile(made.beside(source, kind)) as theirs:
            for name, (_, shape) in ours.contents().items():
                if shape and shape[0] == 250:
                    np.testing.assert_array_equal(ours.read(name), theirs.read(name, 0, 250))
                    compared += 1
        assert compared >= 2


def noisy(path: Path, *, hot: bool = True) -> Path:
    """Random events in 40 slices, which a filter thins out, with a calibration that names a hot pixel, or none."""
    rng = np.random.default_rng(3)
    t, x, y, p = (np.sort(rng.integers(0, 40_000, 3000)), *rng.integers(0, 20, (2, 3000)), rng.integers(0, 2, 3000))
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    named = {"sensor/hot_xy_px": np.array([[4, 5]], np.uint16)} if hot else {}
    return write_recording(path, event_arrays(events, 40) | named)


def read_events(path: Path) -> list[list[int]]:
    with open_recording(path) as recording:
        return np.stack(recording.between(0, len(recording))).tolist()  # type: ignore[no-any-return]


def test_noise_is_left_out(tmp_path: Path) -> None:
    """Assert that what is left is what the filter keeps of the events of no hot pixel, and that the recipe says it."""
    source = noisy(tmp_path / "a.recording.h5")
    left = piece(source, tmp_path, denoise=True, support_ms=0.4)
    assert left.name == "a-denoised.recording.h5"
    with open_recording(source) as recording:
        events = recording.between(0, len(recording))
    kept = NoiseFilter(0.4, (640, 480)).keep(events.at((events.x != 4) | (events.y != 5)))
    assert 0 < len(kept[0]) < events.size / 2
    assert read_events(left) == np.stack(kept).tolist()
    with open_recording(left) as recording:
        assert recording.header["parameters"]["denoised"] == {"support_ms": 0.4}
        np.testing.assert_array_equal(recording.starts, np.searchsorted(kept[0], np.arange(41) * SLICE_US))
    plain = piece(noisy(tmp_path / "b.recording.h5", hot=False), tmp_path, denoise=True)
    with open_recording(plain) as recording:
        assert recording.header["parameters"]["denoised"] == {"support_ms": 2.0}


@pytest.mark.parametrize("support_ms", [0.4, 7.5])
def test_a_denoised_piece_is_a_piece_of_the_denoised(
    tmp_path: Path, support_ms: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that the filter looks at what came before the piece, however the slices are cut into blocks."""
    monkeypatch.setattr(trim, "DENOISED_SLICES", 7)
    source = noisy(tmp_path / "a.recording.h5")
    whole = piece(source, tmp_path, denoise=True, support_ms=support_ms)
    at_once = piece(source, tmp_path / "at_once", denoise=True, support_ms=support_ms, from_ms=11, to_ms=30)
    in_turn = piece(whole, tmp_path / "in_turn", from_ms=11, to_ms=30)
    assert read_events(at_once) == read_events(in_turn) != []
    with open_recording(in_turn) as recording:
        assert recording.header["parameters"]["denoised"] == {"support_ms": support_ms}


@pytest.mark.parametrize(
    "flags", [{"from_ms": 5, "to_ms": 5}, {"from_ms": 6, "to_ms": 2}, {"from_ms": 12}, {"to_ms": 13}]
)
def test_no_such_slices(flags: dict[str, int], tmp_path: Path) -> None:
    """Assert that an empty range, and one beyond the recording, are refused, and nothing is written."""
    whole = rich_recording(tmp_path / "a.recording.h5")
    with pytest.raises(InputError):
        piece(whole, tmp_path / "out", **flags)
    assert not (tmp_path / "out").exists()
