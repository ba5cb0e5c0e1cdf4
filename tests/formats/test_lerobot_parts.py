"""What a data set for policies may hold beyond a vector and a video: event frames, points, other streams.

And what `lerobot-doctor`, a checker by others, says of it.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.exports import export_folder
from evetac_cli.formats.write.lerobot import event_stacks
from evetac_cli.formats.write.lerobot.event_stacks import EventStacks
from evetac_cli.inspect.export import trial_files
from evetac_cli.store.recordings.read import Recording
from tests.formats.trials import write_grasp
from tests.small_files import SLICES

av = pytest.importorskip("av")
pytest.importorskip("pyarrow")
Image = pytest.importorskip("PIL.Image")
FPS = 250
FRAMES = SLICES * FPS // 1000 - 1
ENDS_MS = np.arange(1, FRAMES + 1) * 4
DEPTH, SIZE_PX = 5, (160, 120)
WRIST = np.stack([np.full((6, 8, 3), level, np.uint8) for level in (40, 200)])


def export(folder: Path, sources: list[Path], **options: Any) -> tuple[dict[str, Any], pd.DataFrame]:
    """Write a data set; returns info.json and its frames."""
    row = export_folder(sources, "lerobot", folder, {"fps": FPS, **options}, opened=trial_files)
    info = json.loads((folder / "meta" / "info.json").read_text())
    return info | {"row": row}, pd.read_parquet(folder / "data/chunk-000/file-000.parquet")


def refusal(folder: Path, sources: list[Path], **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        export(folder, sources, **options)
    assert not folder.exists()
    return str(caught.value)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two grasps, with images of a camera at the wrist."""
    folder = tmp_path_factory.mktemp("grasps")
    return [write_grasp(folder, name, seed=seed, streams__wrist__frames=WRIST) for name, seed in (("a", 1), ("b", 2))]


@pytest.fixture(scope="module")
def whole(sources: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """They as one data set, with all that there is."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    options = {"event_frames": f"{DEPTH}@500", "per_frame": "last"}
    info, _ = export(folder, sources, **options)
    assert info["row"]["left_out"] is None
    return folder


def read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    return json.loads((folder / "meta/info.json").read_text()), pd.read_parquet(
        folder / "data/chunk-000/file-000.parquet"
    )


def levels(cell: dict[str, bytes]) -> np.ndarray:
    """The grey levels of a picture as it lies in the table."""
    assert cell["path"] is None
    picture = np.asarray(Image.open(io.BytesIO(cell["bytes"])))
    assert picture.shape == (*SIZE_PX[::-1], 3) and (picture == picture[:, :, :1]).all()
    return picture[:, :, 0].astype(int)


def test_event_frames_are_those_of_the_recording_and_end_with_their_frame(whole: Path, sources: list[Path]) -> None:
    """Assert every pixel of every event frame: events counted one by one, none later than the frame, exact."""
    info, frames = read(whole)
    keys = [f"observation.images.tactile_{place:02d}" for place in range(DEPTH)]
    assert [key for key in info["features"] if key.startswith("observation.images.tactile_")] == keys
    feature = info["features"][keys[0]]
    assert (feature["dtype"], feature["shape"], feature["info"]["events.full_scale"]) == ("image", [120, 160, 3], 16)
    shown = 0
    for episode, source in enumerate(sources):
        rows = frames[frames["episode_index"] == episode]
        with Recording(source) as recording:
            blocks = list(recording.frames(500, SIZE_PX, polarity="signed"))
            images = np.concatenate([block.images[:, 0] for block in blocks])
            for number, end_ms in enumerate(ENDS_MS):
                for place, key in enumerate(keys):
                    stop = int(end_ms) - 2 * (DEPTH - 1 - place)
                    expected = np.zeros(SIZE_PX[::-1], int)
                    if stop > 0:
                        events = recording.between(stop - 2, stop)
                        np.add.at(expected, (events.y // 4, events.x // 4), np.where(events.p > 0, 1, -1))
                        assert (images[stop // 2 - 1] == expected).all()
                    seen = levels(rows[key].iloc[number])
                    assert (np.rint((seen - 128) * 16 / 127) == np.clip(expected, -16, 16)).all()
                    shown += int(np.abs(expected).sum())
    assert shown > 500


def test_levels_are_exact_up_to_the_full_scale() -> None:
    """Assert 128 without events, ends at 1 and 255, and that each count up to the full scale has a level of its own."""
    stacks = EventStacks(16, 200.0, SIZE_PX, event_stacks.full_scale((640, 480), SIZE_PX))
    counts = np.arange(-20, 21, dtype=np.int16)
    seen = stacks.grey(counts).astype(int)
    assert (seen[20], seen[0], seen[-1]) == (128, 1, 255) and len(set(seen[4:37])) == 33
    scaled = (seen - 128) / 254
    assert (scaled.min(), scaled.max(), scaled[20]) == (-0.5, 0.5, 0.0)


def test_streams_are_what_was_known_by_then(whole: Path) -> None:
    """Assert for each frame the last sample before its end, of numbers and of images."""
    info, frames = read(whole)
    assert info["features"]["observation.streams.arm"]["names"] == ["streams_arm_x_m"]
    t_us, x_m = np.arange(5) * 5000, np.linspace(0.0, 1.0, 5)
    last = np.searchsorted(t_us, ENDS_MS * 1000) - 1
    seen = frames["observation.streams.arm"].to_numpy()[:FRAMES]  # one number is no list, see `_column`
    np.testing.assert_allclose(seen, x_m[last], rtol=1e-6)
    path = whole / info["video_path"].format(video_key="observation.images.wrist", chunk_index=0, file_index=0)
    with av.open(str(path)) as video:
        shown = [frame.to_ndarray(format="rgb24").mean() for frame in video.decode(video=0)]
    expected = WRIST[(ENDS_MS > 12).astype(int), 0, 0, 0]
    np.testing.assert_allclose(shown, np.tile(expected, 2), atol=4)


def test_streams_that_are_not_alike_are_left_out(tmp_path: Path) -> None:
    """Assert that a stream of one trial alone, or of other size, is named and not written."""
    without = {f"streams__arm__{name}": None for name in ("t_us", "about", "x_m")}
    some = [
        write_grasp(tmp_path, "a", streams__wrist__frames=WRIST),
        write_grasp(tmp_path, "b", streams__wrist__frames=WRIST[:, :4], **without),
    ]
    info, _ = export(tmp_path / "out", some)
    assert info["row"]["left_out"] == (
        "streams/arm: its columns differ between trials; streams/wrist: its images differ between trials"
    )
    assert not [name for name in info["features"] if "arm" in name or "wrist" in name]


def test_what_cannot_be_chosen_is_refused(sources: list[Path], tmp_path: Path) -> None:
    """Assert words for event frames, sizes and layouts that cannot be."""
    out = tmp_path / "out"
    for text in ("16", "0@200", "65@200", "16@2000", "a@b", "16@0", "-1@200"):
        assert "16@200" in refusal(out, sources, event_frames=text)
    assert "640 x 480" in refusal(out, sources, event_frames="16@200", size=(1280, 720))
    assert "without --event-frames" in refusal(out, sources, size=(160, 120))


def test_the_doctor_of_others_finds_nothing_wrong(whole: Path) -> None:
    """Assert that lerobot-doctor runs all of its checks and none fails; its warnings are about what the grasps do."""
    pytest.importorskip("lerobot_doctor")
    from lerobot_doctor.dataset_loader import load_dataset
    from lerobot_doctor.runner import run_checks

    report = run_checks(load_dataset(str(whole)))
    said = {result.name: result.severity.value for result in report.results}
    assert len(said) >= 10 and "FAIL" not in said.values(), report.results
    for name in ("Metadata & Format Compliance", "Temporal Consistency", "Feature Consistency", "Portability"):
        assert said[name] == "PASS", (name, report.results)
