"""The judge of labels: which slips it plays, what it keeps, and what its table shows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.store.recordings.read import open_recording, ramp_start
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated
from scripts.studies.labels import judge, trials


def row(slip: judge.Slip, method: str, error_px: float, abstained: bool = False) -> dict[str, Any]:
    """A row of a slip whose labels are so far off."""
    told = {"t_s_ms": 100, "t_c_ms": 101, "onset_error_ms": 1, "onset_error_px": error_px, "t_every_node_ms": 103}
    interval = {"interval_covers": True, "interval_width_px": 0.8, "interval_width_ms": 4}
    more = {"onset_before_gross_slip_ms": -3, "abstained": abstained, "cpu_s": 0.1}
    return {**slip._asdict(), "method": method, **told, **interval, **more}


def test_what_is_kept_is_not_played_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a second run plays only what is new, and has the rows of the first."""
    played: list[judge.Slip] = []

    def rows_of(slip: judge.Slip) -> list[dict[str, Any]]:
        played.append(slip)
        return [row(slip, method, 0.1 * slip.object) for method in judge.METHODS]

    monkeypatch.setattr(judge, "rows_of", rows_of)
    first = judge.all_rows("evetac", range(1), 3, tmp_path)
    second = judge.all_rows("evetac", range(1), 5, tmp_path)
    assert [slip.object for slip in played] == [1, 2, 3, 4, 5]
    assert second[:6] == first
    assert len((tmp_path / "evetac.jsonl").read_text().splitlines()) == 10


def test_a_slip_in_memory_is_the_one_that_record_writes(
    short_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that events, truth, commands and dots are those of the file with the same object, seed and sensor."""
    chosen = Record(scene=str(short_scene), objects="8", seed=9)
    (job,) = record.jobs([], chosen, tmp_path)
    simulated.run(job, force=False, progress=lambda *_: None)
    played = trials.play_slip(8, 9, scene=str(short_scene))
    with open_recording(job.output) as written:
        assert len(played) == len(written)
        for one, other in zip(played.between(0, len(played)), written.between(0, len(written)), strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(played.read("truth/slid_px").astype(np.float32), written.read("truth/slid_px"))
        np.testing.assert_array_equal(played.dot_xy_px, written.dot_xy_px)
        assert played.window_px == written.window_px
        assert ramp_start(played.as_recording()) == ramp_start(written)
