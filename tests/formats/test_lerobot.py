"""Data sets for policies: frames come from slices by the stated rule, and the files are those of LeRobotDataset v3.0.

What lerobot itself makes of them: test_lerobot_library.py.
"""

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.exports import export_folder
from evetac_cli.formats.write.lerobot import episodes, meta_files, write_lerobot
from evetac_cli.inspect.export import trial_files
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.store.recordings.read import Recording
from tests.formats.trials import write_grasp
from tests.quick import few
from tests.small_files import DOTS, SLICES

av = pytest.importorskip("av")
pytest.importorskip("pyarrow")
Image = pytest.importorskip("PIL.Image")
FPS = 250
FRAMES = SLICES * FPS // 1000 - 1  # the last whole frame has no action


def written(folder: Path, sources: list[Path], **options: Any) -> dict[str, Any]:
    return export_folder(sources, "lerobot", folder, {"fps": FPS, **options}, opened=trial_files)


def refusal(folder: Path, sources: list[Path], **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        written(folder, sources, **options)
    assert not folder.exists()
    return str(caught.value)


def read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame, pd.DataFrame]:
    """info.json, the frames and the episodes."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    frames = pd.read_parquet(folder / info["data_path"].format(chunk_index=0, file_index=0))
    return info, frames, pd.read_parquet(folder / "meta/episodes/chunk-000/file-000.parquet")


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three grasps, of objects 8, 3 and 8."""
    folder = tmp_path_factory.mktemp("grasps")
    return [write_grasp(folder, name, number, seed) for name, number, seed in (("a", 8, 1), ("b", 3, 2), ("c", 8, 3))]


@pytest.fixture(scope="module")
def out(sources: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """They as one data set, with object 3 to test on."""
    folder = tmp_path_factory.mktemp("lerobot") / "out"
    row = written(folder, sources, test_objects=[3])
    assert (row["episodes"], row["frames"], row["simulated"]) == (3, 3 * FRAMES, True)
    assert row["left_out"] is None
    assert (row["train"], row["test"]) == ("0:2", "2:3")
    return folder


def test_files_and_counts_are_those_of_the_layout(out: Path) -> None:
    """Assert every file of v3.0, whole counts, ranges of episodes, and that all paths in info.json lead to files."""
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()) == [
        "README.md",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/evetac.json",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "videos/observation.images.tactile/chunk-000/file-000.mp4",
        "videos/observation.images.wrist/chunk-000/file-000.mp4",
    ]
    info, frames, episode = read(out)
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", FPS, {"train": "0:2", "test": "2:3"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 3 * FRAMES, 1)
    videos = {"observation.images.tactile", "observation.images.wrist"}
    assert set(frames) == set(info["features"]) - videos
    assert frames["index"].tolist() == list(range(3 * FRAMES))
    assert frames["episode_index"].tolist() == [0] * FRAMES + [1] * FRAMES + [2] * FRAMES
    assert frames["frame_index"].tolist() == 3 * list(range(FRAMES))
    np.testing.assert_allclose(frames["timestamp"], np.tile(np.arange(FRAMES) / FPS, 3), rtol=1e-6)
    assert episode["dataset_from_index"].tolist() == [0, FRAMES, 2 * FRAMES]
    assert episode["dataset_to_index"].tolist() == [FRAMES, 2 * FRAMES, 3 * FRAMES]
    assert episode["object"].tolist() == [8, 8, 3] and episode["trial"].tolist() == ["a", "c", "b"]
    key = "videos/observation.images.tactile"
    np.testing.assert_allclose(episode[f"{key}/to_timestamp"] - episode[f"{key}/from_timestamp"], FRAMES / FPS)
    for name, feature in info["features"].items():
        if feature["dtype"] == "float32" and name != "timestamp":
            assert len(feature["names"]) == feature["shape"][0] == np.size(frames[name][0])
    tasks = pd.read_parquet(out / "meta" / "tasks.parquet")
    assert tasks.loc["an object is lifted"].task_index == 0


def test_vectors_are_those_of_the_trial(out: Path, sources: list[Path]) -> None:
    """Assert state and action at the ends of frames, the action one frame later, and means of the figures of touch."""
    info, frames, _ = read(out)
    first = frames[frames["episode_index"] == 1]  # c: the second of the training objects
    path = sources[2]
    ends = np.arange(1, FRAMES + 2) * 4 - 1
    with h5py.File(path) as h5:
        position, goal = h5["gripper/position_ticks"][()], h5["control/goal_ticks"][()]
        probability = np.nan_to_num(h5["control/probability"][()])
    state, action, touch = (np.stack(first[name]) for name in ("observation.state", "action", "observation.tactile"))
    np.testing.assert_array_equal(state[:, 0], position[ends[:-1] // 2])
    np.testing.assert_array_equal(action[:, 0], goal[ends[1:] // 2])
    with h5py.File(path.with_name("c.features.h5")) as h5:
        moved = h5["displacement_xy_px"][: 4 * FRAMES]
    names = info["features"]["observation.tactile"]["names"]
    expected = moved.reshape(FRAMES, 4, DOTS, 2).mean(axis=1)
    np.testing.assert_allclose(touch[:, names.index("displacement_05_y_px")], expected[:, 5, 1], rtol=1e-5)
    means = probability[: 4 * FRAMES].reshape(FRAMES, 4).mean(axis=1)
    np.testing.assert_allclose(touch[:, names.index("control_probability")], means, rtol=1e-5)
    assert sum(name.startswith("events_per_dot_") for name in names) == DOTS
    assert {"touch_shear_y_n", "touch_normal_n", "touch_sticking_share", "touch_touches"} <= set(names)
    assert not [name for name in names if name.startswith("truth")]  # what only a simulator knows is no observation


def test_pictures_show_the_events_of_their_frame(out: Path, sources: list[Path]) -> None:
    """Assert that the video has a picture a frame, which shows white, black and grey where the events are."""
    with av.open(str(out / "videos/observation.images.tactile/chunk-000/file-000.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height, float(stream.average_rate)) == (640, 480, FPS)
        shown = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]
    assert len(shown) == 3 * FRAMES
    np.testing.assert_allclose([time for time, _ in shown], np.arange(3 * FRAMES) / FPS, atol=1e-4)
    with Recording(sources[2]) as recording:
        for number in range(FRAMES):
            events = recording.between(4 * number, 4 * number + 4)
            drawn = event_image(events.x, events.y, events.p)
            seen = shown[FRAMES + number][1].mean(axis=2) / 127.5 - 1
            assert (np.rint(seen).astype(int) == drawn).mean() > 0.9995
            lit = drawn != 0
            assert lit.sum() >= 36 and np.mean(np.sign(seen[lit]) == drawn[lit]) > 0.9


def test_statistics_of_an_episode_and_of_its_video(out: Path) -> None:
    """Assert quantiles of one episode, and plausible figures of the video's pictures."""
    _, frames, episode = read(out)
    stats = json.loads((out / "meta" / "stats.json").read_text())
    for name in ("observation.state", "observation.tactile", "action"):
        part = np.stack(frames[name][frames["episode_index"] == 0]).astype(np.float64)
        np.testing.assert_allclose(episode[f"stats/{name}/q90"][0], np.quantile(part, 0.9, axis=0), rtol=1e-9)
    image = stats["observation.images.tactile"]
    assert np.shape(image["mean"]) == (3, 1, 1)
    assert (image["min"], image["max"]) == ([[[0.0]]] * 3, [[[1.0]]] * 3)
    assert abs(image["mean"][0][0][0] - 128 / 255) < 1e-3 and 0 < image["std"][0][0][0] < 0.05


@pytest.mark.parametrize("fps", [7, 30, 50, 60, 250, 999, 1000])
def test_frames_take_every_slice_once(fps: int) -> None:
    """Assert that frames follow each other without gap, that none looks ahead, and none is empty."""
    edges = episodes.frame_edges(2345, fps)
    assert edges[0] == 0 and edges[-1] <= 2345 and len(edges) == 2345 * fps // 1000 + 1
    assert set(np.diff(edges)) <= {1000 // fps, 1000 // fps + 1}
    assert np.abs(edges - np.arange(len(edges)) * 1000 / fps).max() < 1


def test_rules_bring_slices_to_frames() -> None:
    """Assert mean, last and stacked of known numbers, where frames have 3 and 4 slices."""
    values = np.arange(20, dtype=np.float32).reshape(10, 2)
    edges = np.array([0, 3, 7, 10])
    assert episodes.frames_of(values, edges, "last", 3).tolist() == [[4, 5], [12, 13], [18, 19]]
    assert episodes.frames_of(values, edges, "mean", 3).tolist() == [[2, 3], [9, 10], [16, 17]]
    stacked = episodes.frames_of(values, edges, "stacked", 3)
    assert stacked.tolist() == [[0, 1, 2, 3, 4, 5], [8, 9, 10, 11, 12, 13], [14, 15, 16, 17, 18, 19]]
    named = episodes.names_of(["a", "b"], "stacked", 3)
    assert named == ["a_2_ms_ago", "b_2_ms_ago", "a_1_ms_ago", "b_1_ms_ago", "a_0_ms_ago", "b_0_ms_ago"]


def test_what_is_not_known_holds_its_last_value() -> None:
    """Assert 0 before the first known value of a column, and then the last known one."""
    values = np.ma.masked_invalid([[np.nan, 1.0], [2.0, np.nan], [np.nan, np.nan], [5.0, 7.0]]).astype(np.float32)
    assert episodes.last_known(values).tolist() == [[0, 1], [2, 1], [2, 1], [5, 7]]


@pytest.mark.parametrize("count", few([2, 5, 20], 2))
def test_statistics_of_the_training_episodes_are_numpys(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert each figure of episodes of unlike length and content as numpy gives it, without the test episodes.

    The values are read in parts that cut columns and files.
    """
    monkeypatch.setattr(write_lerobot, "DATA_MB", 0)
    monkeypatch.setattr(meta_files, "AT_ONCE_BYTES", 50_000)
    rng = np.random.default_rng(count)
    lengths, whole = iter(4 + rng.permutation(20)[:count]), episodes.frame_edges
    monkeypatch.setattr(episodes, "frame_edges", lambda *of: whole(*of)[: next(lengths) + 1])
    sources = [
        write_grasp(
            tmp_path / "in",
            f"g{number:02d}",
            8 if number else 3,  # the first is for testing
            seed=number,
            gripper__position_ticks=rng.integers(300 + 9 * number, 320 + 20 * number, SLICES // 2).astype(np.int32),
            streams__wrist__frames=rng.integers(0, 40 + 10 * number, (2, 6, 8, 3)).astype(np.uint8),
        )
        for number in range(count)
    ]
    written(tmp_path / "out", sources, fps=1000, test_objects=[3], event_frames="2@500")
    frames = pd.concat(map(pd.read_parquet, sorted((tmp_path / "out" / "data").rglob("*.parquet"))))
    assert len(set(frames.groupby("episode_index").size())) == count
    frames = frames[frames["episode_index"] < count - 1]
    stats = json.loads((tmp_path / "out" / "meta" / "stats.json").read_text())
    of_pictures = [name for name in stats if "images" in name]
    for name in set(stats) - set(of_pictures):
        values = np.array([np.stack(np.atleast_1d(cell)) for cell in frames[name]], np.float64)
        assert_figures(stats[name], values.reshape(-1, len(stats[name]["mean"])), len(frames))
    name = "observation.images.tactile_01"
    pictures = [np.asarray(Image.open(io.BytesIO(cell["bytes"]))) for cell in frames[name]]
    assert_figures(stats[name], np.stack(pictures).reshape(-1, 3) / 255, len(frames))
    assert len(of_pictures) == 4 and all(stats[name]["count"] == [len(frames)] for name in of_pictures)


def assert_figures(stated: dict[str, Any], values: np.ndarray, count: int) -> None:
    """Assert that the figures of columns are numpy's."""
    expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    expected |= {key: np.quantile(values, part, axis=0) for key, part in meta_files.QUANTILES.items()}
    assert set(stated) == {*expected, "count"} and stated["count"] == [count]
    for figure, value in expected.items():
        np.testing.assert_allclose(np.ravel(stated[figure]), value, rtol=1e-6, atol=1e-6, err_msg=figure)


def test_quantiles_of_pictures_are_numpys() -> None:
    """Assert quantiles that are a level and that lie between two, of few and of many pixels."""
    rng = np.random.default_rng(0)
    for pixels in (np.array([7]), np.array([0, 255]), rng.integers(0, 256, 11), rng.integers(100, 104, 5000)):
        stated = meta_files.of_pictures(np.bincount(pixels, minlength=256), 1)
        assert_figures(meta_files.as_lists({"x": stated})["x"], np.repeat(pixels[:, None], 3, axis=1) / 255, 1)


@pytest.mark.slow
@pytest.mark.parametrize("per_frame", ["last", "stacked"])
def test_other_rules_and_names(sources: list[Path], tmp_path: Path, per_frame: str) -> None:
    """Assert that the rule and the key of the tactile vector are those that were chosen, and the card says the rule."""
    key = "observation.environment_state"
    written(tmp_path / "out", sources[:1], per_frame=per_frame, tactile_key=key, task="hold it")
    info, frames, episode = read(tmp_path / "out")
    assert info["splits"] == {"train": "0:1"} and episode["tasks"][0].tolist() == ["hold it"]
    columns = [name for name in info["features"][key]["names"] if name.startswith("displacement_05_x_px")]
    touch = np.stack(frames[key])
    with h5py.File(sources[0].with_name("a.features.h5")) as h5:
        moved = h5["displacement_xy_px"][: 4 * FRAMES, 5, 0].reshape(FRAMES, 4)
    at = [info["features"][key]["names"].index(name) for name in columns]
    np.testing.assert_array_equal(touch[:, at], moved if per_frame == "stacked" else moved[:, 3:])
    assert episodes and ("concatenated" in (tmp_path / "out" / "README.md").read_text()) == (per_frame == "stacked")


@pytest.mark.slow
def test_files_grow_no_larger_than_they_may(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that episodes go on in a new file after the size, and the table of episodes says in which."""
    monkeypatch.setattr(write_lerobot, "DATA_MB", 0)
    monkeypatch.setattr(write_lerobot, "VIDEO_MB", 0)
    monkeypatch.setattr(write_lerobot, "CHUNK_FILES", 2)
    written(tmp_path / "out", sources)
    _, _, episode = read(tmp_path / "out")
    for what in ("data", "videos/observation.images.tactile"):
        places = list(zip(episode[f"{what}/chunk_index"], episode[f"{what}/file_index"], strict=True))
        assert places == [(0, 0), (0, 1), (1, 0)]
    assert episode["videos/observation.images.tactile/from_timestamp"].tolist() == [0.0, 0.0, 0.0]
    for number, (chunk, file) in enumerate([(0, 0), (0, 1), (1, 0)]):
        part = pd.read_parquet(tmp_path / "out" / "data" / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet")
        assert set(part["episode_index"]) == {number}


@pytest.mark.slow
def test_trials_that_make_no_episodes_are_refused(tmp_path: Path) -> None:
    """Assert that words say what a trial lacks, and what to do."""
    whole = write_grasp(tmp_path / "in", "a")
    bare = write_grasp(tmp_path / "in", "b", kinds="tracks labels")
    assert "evetac featurize" in refusal(tmp_path / "out", [whole, bare])
    without = ("t_us", "current_target_ma", "current_written_ma", "current_ma", "position_ticks")
    no_gripper = write_grasp(tmp_path / "in", "c", **{f"gripper__{name}": None for name in without})
    assert "no gripper" in refusal(tmp_path / "out", [no_gripper])
    assert "too short" in refusal(tmp_path / "out", [whole], fps=50)
    assert "no trial has" in refusal(tmp_path / "out", [whole], test_objects=[3])
    assert "left to train on" in refusal(tmp_path / "out", [whole], test_objects=[8])
    controls = ("t_us", "u_ff_ticks", "x_ref_ticks", "goal_ticks", "slip", "phase", "missed", "slices_processed")
    ramp = write_grasp(
        tmp_path / "in", "e", **{f"control__{name}": None for name in (*controls, "probability", "outcome")}
    )
    assert "control_goal_ticks in some of them" in refusal(tmp_path / "out", [whole, ramp])
    larger = write_grasp(tmp_path / "in", "d", sensor__frame_px=np.array([1280, 720], np.int32))
    assert "1280 x 720" in refusal(tmp_path / "out", [whole, larger])


@pytest.mark.slow
def test_without_a_controller_the_action_is_the_current(tmp_path: Path) -> None:
    """Assert that a slip, which has no goal position, has the wanted current one frame later as its action."""
    controls = ("t_us", "u_ff_ticks", "x_ref_ticks", "goal_ticks", "slip", "phase", "missed", "slices_processed")
    none = {f"control__{name}": None for name in (*controls, "probability", "outcome")}
    path = write_grasp(tmp_path / "in", "a", gripper__current_target_ma=np.linspace(60.0, 5.0, SLICES // 2), **none)
    written(tmp_path / "out", [path])
    info, frames, _ = read(tmp_path / "out")
    assert info["features"]["action"]["names"] == ["gripper_current_target_ma", "gripper_current_written_ma"]
    wanted = np.linspace(60.0, 5.0, SLICES // 2)[np.arange(2, FRAMES + 2) * 4 // 2 - 1]
    np.testing.assert_allclose(np.stack(frames["action"])[:, 0], wanted, rtol=1e-6)
    assert "control_probability" not in info["features"]["observation.tactile"]["names"]
