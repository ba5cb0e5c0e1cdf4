"""A view beside a recording: what it shows, what its button does, and that nothing that befalls it costs a slice."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import DeviceError
from evetac_cli.events import empty
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile
from evetac_cli.trials import live_view
from evetac_cli.trials.live_view.shared_view import Title
from tests.cli.test_jobs import lives
from tests.patience import PATIENCE_S, until
from tests.trials.live_view.test_server import Client

FAST = ["--seconds", "4", "--expected-event-rate", "1e5"]


def test_a_simulation_is_no_faster_than_real_time() -> None:
    """Assert that what is shown takes its time, and what is not shown does not."""
    shown: list[Any] = []

    class View:
        def add_slice(self, events: Any, probability: float) -> None:
            shown.append(probability)

        def add_command(self, row: Any) -> None:
            shown.append(row["gripper/position_ticks"])

    taken: list[Any] = []
    append = live_view.shown_in_real_time(View(), lambda events, rows: taken.append(rows))  # type: ignore[arg-type]
    began_s = time.monotonic()
    for k in range(100):
        append(empty(), {"control/probability": 0.5, **({"gripper/position_ticks": k} if k == 3 else {})})
    assert time.monotonic() - began_s >= 0.0999
    assert len(taken) == 100
    assert shown == [*[0.5] * 4, 3, *[0.5] * 96]
    assert live_view.shown_in_real_time(None, taken.append) == taken.append  # type: ignore[arg-type]


class Shown:
    """A command with a page, and what a scripted browser sees of it."""

    def __init__(self, run: "subprocess.Popen[str]") -> None:
        self.run = run
        assert run.stderr is not None
        self.said: list[str] = []
        for line in run.stderr:
            self.said.append(line)
            if address := re.search(r"live view: http://(\S+)", line):
                self.address = address.group(1)
                return
        raise AssertionError("".join(self.said))

    def watch(
        self, act: Callable[[Client], None], when: Callable[[dict[str, Any]], bool] = bool
    ) -> list[dict[str, Any]]:
        """All that a client is told until the recording ends.

        act: what it does once there is a sample for which `when` holds.
        """
        client, news, acts = Client(f"http://{self.address}"), [{}], True
        while "ended" not in news[-1] or "sample" in news[-1]:
            one, image = client.next()
            news.append(one)
            assert len(image) in (0, 640 * 480)
            if acts and when(one.get("sample", {})):
                acts = False
                act(client)
        return news[1:]

    def end(self) -> tuple[int, str]:
        """Exit code and all that was said."""
        assert self.run.stderr is not None
        rest = self.run.stderr.read()
        return self.run.wait(PATIENCE_S), "".join(self.said) + rest

    @property
    def view(self) -> int:
        """The process that serves the page."""
        children = Path(f"/proc/{self.run.pid}/task/{self.run.pid}/children").read_text().split()
        (view,) = (pid for pid in children if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text())
        return int(view)


@contextmanager
def shown(folder: Path, command: str, *more: str) -> Iterator[Shown]:
    x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
    dots = np.stack([x, y], axis=-1).tolist()
    (folder / "grid.json").write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots}))
    words = ["--camera", "virtual:prepared=100000", "--calibration", str(folder / "grid.json")]
    words += ["--live", "-o", str(folder / "a.recording.h5"), *more]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    run = subprocess.Popen(
        [sys.executable, "-m", "evetac_cli", command, "-q", *words],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=PACKAGE.parent, env=environment,
    )  # fmt: skip
    try:
        yield Shown(run)
    finally:
        if run.poll() is None:
            run.kill()
        run.communicate()


@pytest.mark.slow
def test_a_recording_is_seen_while_it_is_made(tmp_path: Path) -> None:
    """Assert pictures with dots, slip and force of a recording, and its end in words."""

    def is_whole(sample: dict[str, Any]) -> bool:
        return all(sample.get(name) is not None for name in ("slices", "events_per_s", "probability", "normal_n"))

    with shown(tmp_path, "record", "--gripper", "none", "--expected-event-rate", "1e4") as page:
        news = page.watch(lambda client: page.run.send_signal(signal.SIGINT), is_whole)
        code, said = page.end()
    assert code == 130, said
    assert news[-1]["ended"] == "interrupted"
    seen = [each for each in news[:-1] if each["sample"]["slices"]]
    about = next(each["about"] for each in reversed(news[:-1]) if "about" in each)
    assert about["simulated"]
    assert not about["moves"]
    assert len(seen[-1]["dots"]) == 56
    slices = [each["sample"]["slices"] for each in seen]
    assert slices == sorted(slices)
    with StageFile(tmp_path / "a.recording.h5", "recording") as file:
        assert file.length("ms_to_idx") > slices[-1]


@pytest.mark.slow
def test_the_button_lets_go(tmp_path: Path) -> None:
    """Assert that the button ends a recording as Ctrl-C does: torque off in words, a valid file, exit code 130."""
    more = ["--hold-s", "100", "--expected-event-rate", "1e5", "--watchdog-ms", "500"]
    with shown(tmp_path, "record", "--gripper", "virtual", *more) as page:
        news = page.watch(Client.let_go, lambda sample: sample.get("position_ticks") is not None)
        code, said = page.end()
    assert code == 130, said
    assert "let go by the button of the live view; torque is off (read back)" in said
    assert news[-1]["ended"] == "let go by the button of the live view"
    assert any(each.get("sample", {}).get("position_ticks") is not None for each in news)
    with StageFile(tmp_path / "a.recording.h5", "recording") as file:
        assert file.read("capture/ended") == "let go by the button of the live view"


@pytest.mark.slow
def test_a_recording_goes_on_without_its_view(tmp_path: Path) -> None:
    """Assert that a view that is killed takes no slice with it."""
    with shown(tmp_path, "record", "--gripper", "none", *FAST) as page:
        view = page.view
        assert os.getpriority(os.PRIO_PROCESS, view) == 19
        os.kill(view, signal.SIGKILL)
        code, said = page.end()
    assert code == 0, said
    assert said.count("the live view died (SIGKILL); the recording continues") == 1
    with StageFile(tmp_path / "a.recording.h5", "recording") as file:
        assert file.length("ms_to_idx") == 4001


class Bomb:
    """A detector's opener that nobody can be given: it fails where it is taken."""

    def __init__(self, fails_when_taken: bool) -> None:
        self._fails_when_taken = fails_when_taken

    def __reduce__(self) -> Any:
        return (int, ("gel",)) if self._fails_when_taken else (Bomb, (True,))


@pytest.mark.slow
def test_a_view_that_does_not_come_up_says_why() -> None:
    """Assert that its death while it starts is told with what is known of it."""
    title = Title("record a", simulated=True, moves=False)
    with pytest.raises(DeviceError, match=r"the live view died while it started \(exit code 1"):
        live_view.LiveView(title, Bomb(True))  # type: ignore[arg-type]
    with pytest.raises(DeviceError, match=r"died while it started \(exit code 1: TypeError: .*, in samples.py, line"):
        live_view.LiveView(title, 3)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_view_ends_with_whoever_records(tmp_path: Path) -> None:
    """Assert that a killed recording leaves no server behind, and that its page says what happened."""
    with shown(tmp_path, "record", "--gripper", "none", "--seconds", "60", "--expected-event-rate", "1e4") as page:
        view = page.view
        news = page.watch(lambda client: page.run.kill())
        assert news[-1] == {"ended": "the recording program has ended"}
        assert until(lambda: not lives(view))


@pytest.mark.slow
def test_a_simulated_grasp_is_the_same_with_a_view(tmp_path: Path) -> None:
    """Assert that a view changes no array of a simulated grasp, and shows its probability and gripper."""
    files = []
    for live in (False, True):
        out = tmp_path / f"{live}.recording.h5"
        words = ["grasp", "-q", "--lift-s", "1", "--balance-s", "0", "-o", str(out)]
        words += ["--live"] if live else []
        subprocess.run([sys.executable, "-m", "evetac_cli", *words], cwd=PACKAGE.parent, check=True)
        with StageFile(out, "recording") as file:
            files.append({name: file.read(name) for name in file.contents()} | {"id": file.header["id"]})
    assert files[0].keys() == files[1].keys()
    for name, values in files[0].items():
        np.testing.assert_array_equal(values, files[1][name], err_msg=name)
