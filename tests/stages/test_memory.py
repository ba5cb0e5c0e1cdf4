"""Memory does not grow with the length of a recording."""

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from evetac_cli import stages
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.commands.trim import Trim
from evetac_cli.devices import cameras
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as tracking
from evetac_cli.formats.exports import export
from evetac_cli.formats.read import read_hdf5
from evetac_cli.formats.write import event_files, write_table
from evetac_cli.inspect import validate
from evetac_cli.kernels.labelling import event_flow
from evetac_cli.stages import featurize, label, track, track_rgb, trim
from evetac_cli.store.hdf5 import chunks
from evetac_cli.store.layout import rules
from evetac_cli.store.recordings import read
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from scripts.attack.long_recording import Repeated
from tests.conftest import Made
from tests.make import run_stage

SHORT, LONG = 1000, 3000  # slices
MOST_BYTES_A_SLICE = 200  # a number or two for every slice, such as ms_to_idx; all else is some 1,000 bytes


@pytest.fixture(scope="module")
def folders(made: Made, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A folder with a short recording, and one with a longer one, each with its tracks."""
    both = tmp_path_factory.mktemp("short"), tmp_path_factory.mktemp("long")
    with open_recording(made.recordings[0]) as trial:
        repeated = Repeated(trial, 50.0)
    with pytest.MonkeyPatch.context() as patch:
        for module, name, size in CHUNKS:
            patch.setattr(module, name, size)
        for folder, slices in zip(both, (SHORT, LONG), strict=True):
            repeated.write(folder / "a.recording.h5", slices)
            _on_recording(track, Track(), folder)
            export(folder / "a.recording.h5", "dsec", folder / "a.dsec.h5")
            _import("a.dsec.h5")(folder, folder / "imported.recording.h5")
    return both


def _on_recording(stage: object, chosen: object, folder: Path, out: Path | None = None) -> None:
    run_stage(stage, [folder / "a.recording.h5"], chosen, out)


def _import(source: str, **options: object) -> Callable[[Path, Path], None]:
    def import_file(folder: Path, out: Path) -> None:
        run_stage(record, [], Record(source=folder / source, **options), out)  # type: ignore[arg-type]

    return import_file


def _replay(folder: Path, out: Path) -> None:
    chosen = Grasp(camera=f"replay:{folder / 'a.recording.h5'}")
    run_stage(grasp, [], chosen, out)


CHUNKS = ((chunks, "CHUNK_ROWS", 1 << 13), (chunks, "CHUNK_BYTES", 1 << 16))  # of which a reader holds one
BLOCKS = (
    (stages, "BLOCK_ROWS", 100),
    (track_rgb, "FRAMES", 2),
    (read, "BLOCK_SLICES", 100),
    (event_flow, "BLOCK_SLICES", 100),
    (event_files, "PIECE_EVENTS", 1 << 13),
    (trim, "BLOCK_VALUES", 1 << 13),
    (read_hdf5, "BATCH_ROWS", 1 << 13),
    (rules, "BLOCK_VALUES", 1 << 13),
    (validate, "EVENTS", 1 << 13),
    (cameras, "BLOCK_SLICES", 10),
    (write_table, "BATCH_BYTES", 1 << 18),
    *CHUNKS,
)
COMMANDS: dict[str, Callable[[Path, Path], None]] = {
    "trim": lambda folder, out: _on_recording(trim, Trim(from_ms=100), folder, out),
    "track": lambda folder, out: _on_recording(track, Track(), folder, out),
    "featurize": lambda folder, out: _on_recording(featurize, Featurize(images=True), folder, out),
    "track --rgb": lambda folder, out: _on_recording(track, Track(rgb=True), folder, out),
    "label": lambda folder, out: _on_recording(label, Label(), folder, out),
    "label by flow": lambda folder, out: _on_recording(label, Label(method="farneback"), folder, out),
    "grasp again": _replay,
    "evaluate tracking": lambda folder, out: _evaluate(folder / "a.tracks.h5", out),
    "import": _import("a.dsec.h5"),
    "validate": lambda folder, out: _validate(folder / "imported.recording.h5", folder / "a.tracks.h5"),
    "export dsec": lambda folder, out: _export(folder, "dsec", out),
    "export aedat4": lambda folder, out: _export(folder, "aedat4", out),
    "export parquet": lambda folder, out: _export(folder, "parquet", out),
    "export raw": lambda folder, out: _export(folder, "raw", out),
    "export mcap": lambda folder, out: _export(folder, "mcap", out),
}
SLOW = (
    "grasp again",
    "label by flow",
    "trim",
    "track --rgb",
    "export dsec",
    "export parquet",
)  # commands that take seconds


def _export(folder: Path, format_: str, out: Path) -> None:
    export(folder / "a.recording.h5", format_, out.with_suffix(".out"))


def _evaluate(tracks: Path, out: Path) -> None:
    assert run_stage(tracking, [tracks], EvaluateTracking(), out)[1].summary["with_truth"] == 1


def _validate(*files: Path) -> None:
    assert [row["faults"] for row in validate.run([*files]).rows] == [None] * len(files)


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in COMMANDS]
)
@pytest.mark.slow
def test_m11_memory_does_not_grow_with_length(
    command: str, folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that more than twice the slices take hardly more memory at any moment of a command."""
    for module, name, size in BLOCKS:  # blocks are as large as what a short recording holds: smaller ones show more
        monkeypatch.setattr(module, name, size)
    peaks = []
    for number, folder in enumerate((folders[0], *folders)):  # once before it counts: to compile and to import
        out = tmp_path / str(number)
        out.mkdir()
        gc.collect()
        tracemalloc.start()
        try:
            COMMANDS[command](folder, out / "a.h5")
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[2] - peaks[1] < MOST_BYTES_A_SLICE * (LONG - SHORT)
