"""What LeRobot makes of our data sets, and the page that shows it: slow, with lerobot in an environment of its own.

lerobot 0.4.4 wants older versions of torch, av and OpenCV than evetac; `make lerobot` makes the environment, and
without it the tests that need it are skipped.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from evetac_cli.formats.exports import export_folder
from evetac_cli.inspect.export import trial_files
from tests.formats.trials import write_grasp

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import first_hour

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
LEROBOT = ROOT / ".venv-lerobot"
PAGE = (ROOT / "docs" / "tables.md").read_text()
OFFLINE = {"HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false"}

READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset

data = LeRobotDataset("local/touch", root=sys.argv[1], video_backend="pyav")
rows = [data[at] for at in range(len(data))]
part = LeRobotDataset("local/touch", root=sys.argv[1], episodes=[1], video_backend="pyav")
later = LeRobotDataset(
    "local/touch", root=sys.argv[1], delta_timestamps={"action": [0.0, 1 / data.fps]}, video_backend="pyav"
)
print(json.dumps({
    "episodes": data.num_episodes,
    "part": [int(row["index"]) for row in (part[0], part[len(part) - 1])],
    "timestamp": [float(row["timestamp"]) for row in rows],
    "episode": [int(row["episode_index"]) for row in rows],
    "state": [row["observation.state"].tolist() for row in rows],
    "tactile": [row["observation.tactile"].tolist() for row in rows],
    "action": [row["action"].tolist() for row in rows],
    "picture": [[*row["observation.images.tactile"].shape, float(row["observation.images.tactile"].mean())]
                for row in rows],
    "task": sorted({row["task"] for row in rows}),
    "later": [later[0]["action"][:, 0].tolist(), later[len(later) - 1]["action_is_pad"].tolist()],
    "mean": data.meta.stats["observation.state"]["mean"].tolist(),
    "splits": data.meta.info["splits"],
}))
"""


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment variables for lerobot, without a network and with caches of its own."""
    if not (LEROBOT / "bin" / "python").exists():
        pytest.skip("`make lerobot` makes the environment that this needs")
    home = str(tmp_path_factory.mktemp("home"))
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return kept | OFFLINE | {"HF_HOME": home, "HOME": home}


def test_lerobot_reads_what_we_wrote(tmp_path: Path, lerobot: dict[str, str]) -> None:
    """Assert that its class gives every frame with the values, times, pictures and tasks of ours, and parts of it."""
    grasps = [write_grasp(tmp_path / "in", name, number, seed) for name, number, seed in (("a", 8, 1), ("b", 3, 2))]
    export_folder(grasps, "lerobot", tmp_path / "out", {"fps": 250, "test_objects": [3]}, opened=trial_files)
    call = [str(LEROBOT / "bin" / "python"), "-c", READ, str(tmp_path / "out")]
    done = subprocess.run(call, capture_output=True, text=True, env=lerobot, check=False)
    assert done.returncode == 0, done.stderr[-5000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    ours = pd.read_parquet(tmp_path / "out" / "data" / "chunk-000" / "file-000.parquet")
    assert (seen["episodes"], len(seen["state"]), seen["task"]) == (2, len(ours), ["an object is lifted"])
    for name, column in (("state", "observation.state"), ("tactile", "observation.tactile"), ("action", "action")):
        np.testing.assert_array_equal(np.array(seen[name], np.float32), np.stack(ours[column]))
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


def test_a_policy_takes_steps_on_the_page_s_data_set(followed: Path, lerobot: dict[str, str]) -> None:
    """Assert that ACT takes ten training steps, with a finite loss in each, by the command of the page."""
    (block,) = [block.code for block in first_hour.blocks(PAGE) if "lerobot-train" in block.code]
    (followed / LEROBOT.name).symlink_to(LEROBOT)
    done = subprocess.run(
        ["bash", "-ec", block], cwd=followed, env=lerobot, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-5000:]
    losses = [float(loss) for loss in re.findall(r"loss:(\S+)", done.stdout + done.stderr)]
    assert len(losses) == 10 and np.isfinite(losses).all()
