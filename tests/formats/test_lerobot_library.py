"""What LeRobot makes of our data sets and our camera, and the page that shows it: slow, in environments of its own.

lerobot wants older versions of torch, av and OpenCV than evetac, and 0.6.1 a newer Python; `make lerobot` makes the
environments, one a version, and without them the tests that need them are skipped.
"""

import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from evetac_cli.formats.exports import export_folder
from evetac_cli.inspect.export import trial_files
from scripts import first_hour
from tests.formats.trials import write_grasp

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
NEWEST = "0.6.1"
LEROBOTS = {NEWEST: ROOT / ".venv-lerobot", "0.4.4": ROOT / ".venv-lerobot-0.4.4"}
PAGE = (ROOT / "docs" / "tables.md").read_text()
OFFLINE = {"HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false"}

CAMERA_S = 60
READ = """
import json, sys
from importlib.metadata import version
from lerobot.datasets.lerobot_dataset import LeRobotDataset

data = LeRobotDataset("local/touch", root=sys.argv[1], video_backend="pyav")
rows = [data[at] for at in range(len(data))]
part = LeRobotDataset("local/touch", root=sys.argv[1], episodes=[1], video_backend="pyav")
later = LeRobotDataset(
    "local/touch", root=sys.argv[1], delta_timestamps={"action": [0.0, 1 / data.fps]}, video_backend="pyav"
)
try:
    from lerobot.utils.feature_utils import dataset_to_policy_features
except ImportError:
    from lerobot.datasets.utils import dataset_to_policy_features

seen_by_policies = dataset_to_policy_features(data.meta.features)
info = data.meta.info if isinstance(data.meta.info, dict) else vars(data.meta.info)
stack = [key for key in data.meta.features if key.startswith("observation.images.tactile_")]
print(json.dumps({
    "version": version("lerobot"),
    "seen_by_policies": {name: feature.type.name for name, feature in seen_by_policies.items()},
    "stack": [[float(row[key].sum()) for key in stack] for row in rows],
    "shape": [list(rows[0][key].shape) for key in stack],
    "others": [float(row["observation.streams.arm"].reshape(-1)[0]) for row in rows],
    "episodes": data.num_episodes,
    "part": [int(row["index"]) for row in (part[0], part[len(part) - 1])],
    "timestamp": [float(row["timestamp"]) for row in rows],
    "episode": [int(row["episode_index"]) for row in rows],
    "state": [row["observation.state"].tolist() for row in rows],
    "action": [row["action"].tolist() for row in rows],
    "picture": [[*row["observation.images.tactile"].shape, float(row["observation.images.tactile"].mean())]
                for row in rows],
    "task": sorted({row["task"] for row in rows}),
    "later": [later[0]["action"][:, 0].tolist(), later[len(later) - 1]["action_is_pad"].tolist()],
    "mean": data.meta.stats["observation.state"]["mean"].tolist(),
    "splits": info["splits"],
}))
"""


CAMERA = """
import json, sys
import numpy as np
from evetac_cli.devices.cameras import prepared_words
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.realtime.shared_time import SharedTime
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
config = CameraConfig.get_choice_class("evetac")(camera="virtual:prepared=200000")
made = make_cameras_from_configs({"touch": config})["touch"]
made.connect()
names = [type(made).__name__, made.read_latest().shape, made.async_read(5000).shape]
made.disconnect()
words = prepared_words(200_000, np.random.SeedSequence(0), SharedTime())
camera = type(made)(config, DvxplorerCamera(backend=VirtualDvxplorer(words)))
camera.connect(warmup=False)
count = int(sys.argv[1]) * 200
greys = np.stack([camera.read()[:, :, 0] for _ in range(count)])
print(json.dumps({
    "names": names,
    "frames": count,
    "lost": [camera.frames_lost, sum(camera.counted.values())],
    "unlike_the_next": int((greys[1:] != greys[:-1]).any(axis=(1, 2)).sum()),
    "as_a_second_ago": int((greys[200:] == greys[:-200]).all(axis=(1, 2)).sum()),
}))
camera.disconnect()
"""


@pytest.fixture(scope="module", params=LEROBOTS)
def lerobot(request: pytest.FixtureRequest) -> Path:
    """The environment of a version of lerobot."""
    folder = LEROBOTS[request.param]
    if not (folder / "bin" / "python").exists():
        pytest.skip("`make lerobot` makes the environment that this needs")
    return folder


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment variables for lerobot, without a network and with caches of its own."""
    home = str(tmp_path_factory.mktemp("home"))
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return kept | OFFLINE | {"HF_HOME": home, "HOME": home}


def test_lerobot_reads_what_we_wrote(tmp_path: Path, lerobot: Path, settings: dict[str, str]) -> None:
    """Assert that its class gives every frame with the values, times, pictures and tasks of ours, and parts of it."""
    grasps = [write_grasp(tmp_path / "in", name, number, seed) for name, number, seed in (("a", 8, 1), ("b", 3, 2))]
    options = {"fps": 250, "test_objects": [3], "event_frames": "16@200"}
    export_folder(grasps, "lerobot", tmp_path / "out", options, opened=trial_files)
    call = [str(lerobot / "bin" / "python"), "-c", READ, str(tmp_path / "out")]
    done = subprocess.run(call, capture_output=True, text=True, env=settings, check=False)
    assert done.returncode == 0, done.stderr[-5000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    assert LEROBOTS[seen["version"]] == lerobot
    ours = pd.read_parquet(tmp_path / "out" / "data" / "chunk-000" / "file-000.parquet")
    assert (seen["episodes"], len(seen["state"]), seen["task"]) == (2, len(ours), ["an object is lifted"])
    for name, column in (("state", "observation.state"), ("action", "action")):
        np.testing.assert_array_equal(np.array(seen[name], np.float32), np.stack(ours[column]))
    np.testing.assert_allclose(seen["others"], ours["observation.streams.arm"], rtol=1e-6)
    assert all(seen["seen_by_policies"][f"observation.images.tactile_{place:02d}"] == "VISUAL" for place in range(16))
    assert seen["shape"] == 16 * [[3, 120, 160]]
    sums = [[_sum(row[f"observation.images.tactile_{place:02d}"]) for place in range(16)] for _, row in ours.iterrows()]
    np.testing.assert_allclose(seen["stack"], sums, rtol=1e-5)
    np.testing.assert_array_equal(np.array(seen["timestamp"], np.float32), ours["timestamp"])
    assert seen["episode"] == ours["episode_index"].tolist()
    assert [tuple(shape) for *shape, _ in seen["picture"]] == [(3, 480, 640)] * len(ours)
    assert all(abs(mean - 128 / 255) < 0.01 for *_, mean in seen["picture"])
    length = len(ours) // 2
    assert seen["part"] == [length, 2 * length - 1]
    action = np.stack(ours["action"])
    assert seen["later"] == [[action[0, 0], action[1, 0]], [False, True]]
    np.testing.assert_allclose(seen["mean"], np.stack(ours["observation.state"]).mean(axis=0), rtol=1e-5)
    assert seen["splits"] == {"train": "0:1", "test": "1:2"}


def _sum(cell: dict[str, bytes]) -> float:
    """Of all values of a picture, from 0 to 1."""
    return float(np.asarray(Image.open(io.BytesIO(cell["bytes"]))).sum() / 255)


def test_the_camera_hands_out_every_frame_of_a_minute(settings: dict[str, str]) -> None:
    """Assert 12,000 frames at 200 Hz, none lost, none twice, through lerobot, from a virtual camera whose clock waits.

    The camera's words repeat every second. So do its frames, all but the one in which the camera started; a frame that
    was lost or came twice would end that.
    """
    if not (LEROBOTS[NEWEST] / "bin" / "python").exists():
        pytest.skip("`make lerobot` makes the environment that this needs")
    call = [str(LEROBOTS[NEWEST] / "bin" / "python"), "-c", CAMERA, str(CAMERA_S)]
    done = subprocess.run(call, capture_output=True, text=True, env=settings, check=False)
    assert done.returncode == 0, done.stderr[-5000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["names"] == ["EvetacCamera", [120, 160, 3], [120, 160, 3]]
    assert (seen["frames"], seen["lost"]) == (200 * CAMERA_S, [0, 0])
    assert seen["unlike_the_next"] == seen["frames"] - 1
    assert seen["as_a_second_ago"] >= seen["frames"] - 200 - 1


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the page were run, but for those of lerobot."""
    folder = tmp_path_factory.mktemp("page")
    program = folder / "bin" / "evetac"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m evetac_cli "$@"\n')
    program.chmod(0o755)
    settings = os.environ | {"PATH": f"{program.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    ran = [block.code for block in first_hour.blocks(PAGE) if "lerobot-train" not in block.code]
    assert len(ran) >= 3
    for code in ran:
        done = subprocess.run(
            ["bash", "-ec", code], cwd=folder, env=settings, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, code + done.stderr[-3000:]
    return folder


def test_the_snippets_of_the_page_run(followed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that pandas, polars and duckdb read what the page's commands wrote."""
    for library in ("duckdb", "polars"):
        pytest.importorskip(library)
    monkeypatch.chdir(followed)
    snippets = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    assert len(snippets) >= 3
    for snippet in snippets:
        exec(snippet, {})


def test_a_policy_takes_steps_on_the_page_s_data_set(followed: Path, lerobot: Path, settings: dict[str, str]) -> None:
    """Assert that ACT takes ten training steps, with a finite loss in each, by the command of the page.

    The data set has stacks of event frames, of which the policy takes each in as a picture.
    """
    (block,) = [block.code for block in first_hour.blocks(PAGE) if "lerobot-train" in block.code]
    features = json.loads((followed / "touch" / "meta" / "info.json").read_text())["features"]
    assert len([key for key in features if key.startswith("observation.images.tactile_")]) == 16
    environment = followed / LEROBOTS[NEWEST].name
    environment.unlink(missing_ok=True)
    environment.symlink_to(lerobot)
    shutil.rmtree(followed / "outputs", ignore_errors=True)
    done = subprocess.run(
        ["bash", "-ec", block], cwd=followed, env=settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-5000:]
    losses = [float(loss) for loss in re.findall(r"loss:(\S+)", done.stdout + done.stderr)]
    assert len(re.findall(r"step:\d+", done.stdout + done.stderr)) == 10
    assert len(losses) >= 10 and np.isfinite(losses).all()
