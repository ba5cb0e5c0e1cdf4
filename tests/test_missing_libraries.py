"""A library that only some commands need and that is not there: one kind of error, one exit code, whatever needs it."""

import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli import errors
from evetac_cli.cli.main import app
from evetac_cli.errors import EXTRAS, install_hint
from evetac_cli.formats.write.event_files import write_aedat4
from evetac_cli.jobs import silent
from evetac_cli.store.recordings.read import Recording
from tests import small_files

# What is not there, the command that needs it ({f}: a recording, {o}: the folder of outputs), and the extra.
NEEDED = {
    "AEDAT4": ("lz4", "record --from events.aedat4 -o {o}", "convert"),
    "bag": ("rosbags", "record --from events.bag -o {o}", "convert"),
    "MCAP": ("rosbags", "record --from events.mcap -o {o}", "convert"),
    "filter of HDF5": ("hdf5plugin", "record --from packed.h5 -o {o}", "convert"),
    "stream of a table": ("pyarrow", "attach {f} --stream pose=pose.csv -o {o}", "convert"),
    "stream of a bag": ("rosbags", "attach {f} --stream pose=events.bag:/arm -o {o}", "convert"),
    "export to AEDAT4": ("faery", "export {f} --format aedat4 -o {o}/a.aedat4", "convert"),
    "export to MCAP": ("mcap", "export {f} --format mcap -o {o}/a.mcap", "convert"),
    "export to CSV": ("pyarrow", "export {f} --format csv -o {o}/a.csv", "convert"),
    "export to Parquet": ("pyarrow", "export {f} --format parquet -o {o}/tables", "convert"),
    "export to LeRobot": ("av", "export {f} --format lerobot -o {o}/touch", "convert"),
    "view": ("bokeh", "view {f} -o {o}/a.html", "plot"),
    "view, images": ("PIL", "view {f} -o {o}/a.html", "plot"),
    "report": ("matplotlib", "report . -o {o}/a.html", "plot"),
    "Dask": ("distributed", "track {f} --engine dask:tcp://127.0.0.1:1 -o {o}", "cluster"),
    "dv": ("dv_processing", "record --camera dv --seconds 0.1 -o {o}/a.recording.h5", "camera"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, and files that begin as those of other programs do."""
    folder = tmp_path_factory.mktemp("files")
    small_files.recording(folder / "a.recording.h5")
    with Recording(folder / "a.recording.h5") as recording:
        write_aedat4(recording, folder / "events.aedat4", silent)
    (folder / "events.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (folder / "events.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    (folder / "pose.csv").write_text("t_ms,x\n1,2\n3,4\n")
    with h5py.File(folder / "packed.h5", "w") as file:
        for column in "txyp":
            # Number 32015 is Zstandard, which h5py has not got; the rows are stored as they are.
            made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            made.set_chunk((8,))
            made.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
            space = h5py.h5s.create_simple((8,))
            name = f"events/{column}".encode()
            links = h5py.h5p.create(h5py.h5p.LINK_CREATE)
            links.set_create_intermediate_group(True)
            dataset = h5py.h5d.create(file.id, name, h5py.h5t.NATIVE_UINT16, space, made, links)
            dataset.write_direct_chunk((0,), np.arange(8, dtype=np.uint16).tobytes(), 1)
    return folder


@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_library_ends_with_one_exit_code(
    name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert exit code 1, the kind of error and how to install the extra, as words and as JSON, and nothing written."""
    missing, command, extra = NEEDED[name]
    for module in [one for one in sys.modules if one.partition(".")[0] == missing]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, missing, None)
    if name == "filter of HDF5":
        monkeypatch.setattr(h5py.h5z, "filter_avail", lambda number: number < 32_002)
    monkeypatch.chdir(folder)
    words = command.format(f="a.recording.h5", o=tmp_path / "out").split()
    result = CliRunner().invoke(app, [*words, "--json"])
    assert result.exit_code == 1, result.output
    error = json.loads(result.stdout)["error"]
    assert error["kind"] == "MissingLibrary"
    assert error["exit_status"] == 1
    assert error["hint"].startswith(install_hint(extra))
    assert missing.replace("_", "-") in error["message"] or name in ("view, images", "filter of HDF5"), error
    assert error["message"] in result.stderr and error["hint"] in result.stderr
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_each_extra_is_tried() -> None:
    """Assert that the commands above need every extra but `robot`, whose libraries no command loads, and `log`."""
    assert {extra for _, _, extra in NEEDED.values()} == EXTRAS.keys() - {"robot", "log"}
    for extra in EXTRAS:
        assert isinstance(errors.missing_extra("m", extra), errors.MissingLibrary)
