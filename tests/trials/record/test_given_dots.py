"""record --from-dots: the recording of dots that another simulator moved, and what its files may hold."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as tracking
from evetac_cli.formats.read.dot_motion import read_motion
from evetac_cli.inspect import info
from evetac_cli.jobs import Outcome
from evetac_cli.stages import track
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record

REST_PX = np.stack(np.meshgrid(np.arange(80.0, 600.0, 65.0), np.arange(60.0, 440.0, 60.0)), axis=-1)
TIMES_S = np.arange(25) / 60


def moved() -> Floats:
    return REST_PX + 4.0 * np.sin(6.0 * TIMES_S)[:, None, None, None]


def arrays(**more: Any) -> dict[str, Any]:
    force = np.linspace(0.0, 2.0, len(TIMES_S))
    truth = {"normal_force_n": force, "shear_force_n": np.stack([force, 0 * force], axis=1), "slip": TIMES_S > 0.3}
    return {"t_s": TIMES_S, "dot_xy_px": moved(), **truth, "slip_share": np.minimum(3 * TIMES_S, 1.0), **more}


def recorded(path: Path, **flags: Any) -> Outcome:
    params = Record(dots=path, **flags)
    (job,) = record.jobs([], params, None)
    return record.run(job, params)


def test_a_recording_of_given_dots_goes_through_the_stages(tmp_path: Path) -> None:
    """Assert its slices, its truth, that its dots are tracked and judged, and that a second run has nothing to do."""
    path = tmp_path / "pressed.npz"
    np.savez(path, **arrays())
    assert recorded(path).rows[0]["slices"] == 400
    output = tmp_path / "pressed.recording.h5"
    with open_recording(output) as recording:
        assert len(recording) == 400 and recording.event_count > 1000
        np.testing.assert_allclose(recording.read("truth/normal_force_n")[[0, 199, 399]], [0.005, 1.0, 2.0], atol=1e-6)
        slip = recording.read("truth/slip")
        assert not slip[:310].any() and slip[320:].all()
        assert recording.header["parameters"]["sensor"] == "evetac" and recording.header["simulated"]
    (job,) = track.jobs([output], Track(), None)
    track.run(job, Track())
    (report,) = tracking.jobs([job.output], EvaluateTracking(), tmp_path / "r.report.h5")
    summary = tracking.run(report, EvaluateTracking()).summary
    assert summary["error_px_rms"] < 0.25 * summary["still_px_rms"]
    assert info.run([output]).rows[0]["kind"] == "recording"
    assert not recorded(path).made
    with pytest.raises(InputError, match="seed"):
        recorded(path, seed=1)


def test_forces_may_be_unknown(tmp_path: Path) -> None:
    """Assert that dots alone are enough, and that what needs more says what is missing."""
    path = tmp_path / "dots.npz"
    np.savez(path, t_s=TIMES_S, dot_xy_mm=(moved() - np.array([320.0, 240.0])) * 0.0329)
    recorded(path)
    with StageFile(tmp_path / "dots.recording.h5") as file:
        names = {name for name in file.contents() if name.startswith("truth/")}
    assert names == {"truth/dot_xy_px", "truth/sampled_parameters"}


def test_tables_of_dots_are_read(tmp_path: Path) -> None:
    """Assert that a parquet table with a row per time and dot gives the arrays of an npz."""
    parquet = pytest.importorskip("pyarrow.parquet")
    pyarrow = pytest.importorskip("pyarrow")
    whole = arrays()
    dots = moved().reshape(len(TIMES_S), -1, 2)
    count = dots.shape[1]
    columns = {
        "t_s": np.repeat(TIMES_S, count),
        "dot": np.tile(np.arange(count), len(TIMES_S)),
        "x_px": dots[..., 0].ravel(),
        "y_px": dots[..., 1].ravel(),
        "normal_force_n": np.repeat(whole["normal_force_n"], count),
        "shear_force_x_n": np.repeat(whole["shear_force_n"][:, 0], count),
        "shear_force_y_n": np.repeat(whole["shear_force_n"][:, 1], count),
    }
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    np.savez(tmp_path / "a.npz", **whole)
    table, packed = read_motion(tmp_path / "a.parquet"), read_motion(tmp_path / "a.npz")
    np.testing.assert_array_equal(table.t_s, packed.t_s)
    np.testing.assert_array_equal(table.dot_xy, packed.dot_xy.reshape(table.dot_xy.shape))
    np.testing.assert_array_equal(table.truth["shear_force_n"], packed.truth["shear_force_n"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t_s": None}, "t_s, and dot_xy_px"),
        ({"dot_xy_mm": moved()}, "dot_xy_px or dot_xy_mm"),
        ({"t_s": TIMES_S[1:]}, "do not fit each other"),
        ({"t_s": TIMES_S[::-1]}, "a time after"),
        ({"slip": np.zeros(3)}, "slip does not fit"),
        ({"normal_force_n": np.full(len(TIMES_S), np.nan)}, "normal_force_n does not fit"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    """Assert what is said about missing arrays and those that do not fit, and that nothing is written."""
    path = tmp_path / "wrong.npz"
    np.savez(path, **{name: values for name, values in (arrays() | change).items() if values is not None})
    with pytest.raises(InputError, match=message):
        recorded(path)
    assert [one.name for one in tmp_path.iterdir()] == ["wrong.npz"]
    for flags, words in (({"source": path}, "two files"), ({"camera": "virtual"}, "a file and a camera"),
                         ({"scene": "press"}, "scene")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            recorded(path, **flags)
    other = tmp_path / "dots.txt"
    other.write_text("")
    with pytest.raises(InputError, match=r"\.npz, \.parquet"):
        recorded(other)
