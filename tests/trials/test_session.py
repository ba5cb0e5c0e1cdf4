"""What `record` and `grasp` in real time share: how a trial ends, and what is said of it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import DeviceError, attached_outcome
from evetac_cli.jobs import Outcome
from evetac_cli.resources import PACKAGE
from evetac_cli.trials import session
from tests.patience import PATIENCE_S

RESULT = Outcome([{"slices": 3}], simulated=False)


def test_an_error_says_what_was_saved() -> None:
    """Assert that an error goes on with what was saved and the rows of its files, and any other as a DeviceError."""
    with pytest.raises(DeviceError, match="unplugged(.|\n)*kept: .*3 slices in a.h5") as failed:
        session.raise_end(DeviceError("unplugged"), "unplugged", "3 slices in a.h5", RESULT)
    assert attached_outcome(failed.value) is RESULT
    with pytest.raises(DeviceError, match="out of range"):
        session.raise_end(ValueError("out of range"), session.INTERRUPTED, "nothing", None)


def test_an_interrupt_goes_on() -> None:
    """Assert that Ctrl-C goes on as such, and that a trial which simply ended raises nothing."""
    with pytest.raises(KeyboardInterrupt, match="interrupted; torque is off: 3 slices") as stopped:
        session.raise_end(None, session.INTERRUPTED, "3 slices", RESULT, "torque is off")
    assert attached_outcome(stopped.value) is RESULT
    session.raise_end(None, "the camera's stream ended", "3 slices", RESULT)
    with pytest.raises(KeyboardInterrupt, match="the camera's stream ended: 3 slices"):
        session.raise_end(None, "the camera's stream ended", "3 slices", RESULT, interrupted=True)


def test_losses_are_datasets_and_words() -> None:
    """Assert that every loss is a dataset, also one that did not happen, and that only what was lost is in the row."""
    datasets = session.lost_datasets({"camera.late_events": 3, "gripper.answers_lost": 0})
    assert datasets == {"capture/lost/camera.late_events": 3, "capture/lost/gripper.answers_lost": 0}
    why = "camera.late_events 3"
    assert session.lost_columns({**datasets, "capture/ended": "the end"}) == {"lost": 3, "lost_why": why}
    assert session.lost_columns({}) == {"lost": 0, "lost_why": None}


def test_times_of_a_long_recording_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the spread of few times is exact, and that few of many are kept, with median and longest."""
    monkeypatch.setattr(session, "MOST_TIMES", 64)
    times = session.TimeSample()
    assert times.spread() is None
    few = np.random.default_rng(0).uniform(0.0, 900.0, 63)
    for value in few:
        times.add(float(value))
    np.testing.assert_array_equal(times.spread(), np.percentile(few, [50, 99, 100]))
    for value in [*range(10_000), 77_777, *range(10_000)]:
        times.add(float(value))
    median, _, most = times.spread()
    assert len(times._values) < 64
    assert median == pytest.approx(5000, abs=1000)
    assert most == 77_777


def test_json_has_no_nan() -> None:
    """Assert that missing dots, wherever they are nested, become null."""
    assert session.without_nan({"a": [1.0, float("nan"), [float("nan")]], "b": "c"}) == {
        "a": [1.0, None, [None]],
        "b": "c",
    }


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.trials import session
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.segments import RecordingWriter

static = {"sensor/frame_px": np.array([640, 480], np.int32), "sensor/name": "e", "t_offset": np.int64(0)}
recipe = Recipe("recording", 1, {})
writer = RecordingWriter(Path(sys.argv[1]), static, recipe=recipe)
count = 100000
t = np.sort(np.random.default_rng(0).integers(0, 1000, count))
writer.append(Events(t, *(np.ones(count, kind) for kind in ("u2", "u2", "u1"))))
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, resource.RLIM_INFINITY))
try:
    session.finish(writer, recipe, {})
except InputError as error:
    print("File too large" in str(error), "evetac validate --repair" in str(error), writer.folder.exists())
"""


def test_low_a_full_disk_before_the_first_segment_advises_no_repair(tmp_path: Path) -> None:
    """Assert that where nothing of a recording is on disk, no folder stays and nobody is sent to repair it."""
    run = [sys.executable, "-c", FULL_DISK, str(tmp_path / "a.recording.h5")]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.stdout, done.stderr) == ("True False False\n", "")


def test_a_slice_is_late_where_events_follow_it() -> None:
    """Assert that lateness counts where the camera spoke on, and not where it was silent."""
    late = session.LateSlices()
    for late_us, events in ((5001.0, 3), (100.0, 1), (5001.0, 3), (9000.0, 0), (9000.0, 2), (5000.0, 2), (5001.0, 2)):
        late.add(late_us, events)
    assert late.count == 2  # the first, and the fifth


def slow(datasets: dict[str, Any], late: int = 0, behind_s: float | None = 0.0, most_us: float = 5000.0) -> str | None:
    """What is said of 1000 slices, some of them late, and 999 commands."""
    late_slices = session.LateSlices(most_us)
    late_slices.count = late
    return session.too_slow(datasets, 1000, late_slices, 999, behind_s)


@pytest.mark.parametrize(
    ("datasets", "figures", "words"),
    [
        ({"capture/command_misses": 1}, {}, None),  # of a thousand
        ({"capture/command_misses": 2}, {}, "2 of 1,001 commands were missed"),
        ({}, {"late": 1}, None),
        ({}, {"late": 2}, "2 of 1,000 slices arrived more than 5 ms late (slip was answered late)"),
        ({}, {"late": 2, "behind_s": None, "most_us": 5e5}, "more than 500 ms late (all are in the file)"),
        ({"capture/lost/camera.events_in_full_queue": 1}, {}, "1 events were lost"),
        ({"capture/lost/camera.unknown_words": 9}, {}, None),  # the camera's fault
        ({}, {"behind_s": 0.5}, None),
        ({}, {"behind_s": 0.6}, "the recorder lagged 0.6 s behind"),
    ],
)
def test_what_the_computer_was_too_slow_for(
    datasets: dict[str, Any], figures: dict[str, Any], words: str | None
) -> None:
    said = slow(datasets, **figures)
    if words is None:
        assert said is None
    else:
        assert said is not None
        assert said.startswith("this computer was too slow: ")
        assert words in said
        assert said.endswith("`evetac doctor speed` reports what is too slow")
