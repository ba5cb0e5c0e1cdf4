"""--live: a picture of characters, and nothing written."""

from pathlib import Path

import numpy as np

from evetac_cli.events import Events, empty
from evetac_cli.params.recording import Record
from evetac_cli.stages import record
from evetac_cli.stages.record import live_view
from tests.conftest import Made


def at(x: int, y: int, count: int) -> Events:
    """So many events of one pixel."""
    one = np.ones(count)
    return Events((0 * one).astype(np.int64), (x * one).astype("u2"), (y * one).astype("u2"), one.astype("u1"))


def test_picture_is_where_the_events_are() -> None:
    """Assert that events darken their own place only, more events more, and no event nothing; edges included."""
    lines = live_view.picture([at(0, 0, 1), at(639, 479, 500)], (640, 480)).splitlines()
    assert len(lines) == live_view.ROWS
    assert {len(line) for line in lines} == {live_view.COLUMNS}
    assert lines[0][0] != " "
    assert live_view.SHADES.index(lines[-1][-1]) > live_view.SHADES.index(lines[0][0])
    assert "".join(lines).count(" ") == live_view.ROWS * live_view.COLUMNS - 2
    assert set(live_view.picture([empty()], (640, 480))) == {" ", "\n"}


def test_nothing_is_written(made: Made, tmp_path: Path) -> None:
    """Assert that a live view of a camera or a simulation reports its rate and leaves no file."""
    for camera in ("sim", f"replay:{made.recordings[0]}"):
        scene = {"scene": str(made.scene)} if camera == "sim" else {}
        params = Record(camera=camera, live=True, seconds=0.2, **scene)
        (job,) = record.jobs([], params, tmp_path)
        shown = record.run(job, params)
        assert shown.rows[0]["slices"] == 200
        assert shown.rows[0]["events_per_s"] == shown.rows[0]["events"] / 0.2
        assert shown.simulated
    assert list(tmp_path.iterdir()) == []
