"""Imports as recordings: what the user says of a file is in the recording's header, and changes what is made."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record

# A camera that was restarted after 4 s, and one event that came 2 s late.
T_US = np.concatenate([np.arange(0, 4_000_000, 1000), np.arange(500, 2_000_000, 1000)])
T_US[3000] -= 2_000_000


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{t} {t % 640} {t % 480} 1\n" for t in T_US.tolist()))
    return path


def imported(source: Path, **options: Any) -> Outcome:
    params = Record(source=source, frame_size="640x480", **options)
    (job,) = record.jobs([], params, source.with_suffix(".recording.h5"))
    return record.run(job, params)


def test_what_is_kept_of_a_file_is_said_in_its_recording(source: Path) -> None:
    """Assert that the option is in the header, the events are those of the part, and counts say what was left out."""
    with pytest.raises(InputError, match="time goes backwards"):
        imported(source)
    assert not source.with_suffix(".recording.h5").exists()
    outcome = imported(source, from_restart=2)
    assert outcome.made
    with StageFile(source.with_suffix(".recording.h5")) as file:
        parameters = file.header["parameters"]
    assert parameters["from_restart"] == 2
    assert parameters["dropped"]["other_parts"] == 4000
    assert "drop_late" not in parameters
    with open_recording(source.with_suffix(".recording.h5")) as recording:
        assert recording.event_count == 2000
        assert len(recording) == 2000
    assert not imported(source, from_restart=2).made


def test_another_option_is_another_recording(source: Path) -> None:
    """Assert that a recording of one part is not taken for that of another; and that two options are one too many."""
    imported(source, from_restart=0)
    with pytest.raises(InputError, match="another recipe"):
        imported(source, from_restart=1)
    with pytest.raises(InputError, match="--sort and --drop-late"):
        imported(source, sort=True, drop_late=True)


@pytest.mark.parametrize("count", [1, 3])
def test_late_events_are_counted(tmp_path: Path, count: int) -> None:
    """Assert that events which are dropped for being late are counted in the outcome."""
    t = np.arange(0, 4_000_000, 1000)
    t[2000 : 2000 + count] -= 1_000_000
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{us} 1 1 1\n" for us in t.tolist()))
    (row,) = imported(path, drop_late=True).rows
    assert (row["events"], row["dropped"]) == (4000 - count, count)
