"""The slips that labels are judged on are those that `record` writes."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.store.recordings.read import open_recording, ramp_start
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated
from scripts.studies.labels import trials


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
