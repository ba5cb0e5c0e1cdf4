"""Export recordings to files, or to a folder of many trials, that other programs read; one table lists the formats.

Event formats store the events of a recording. A note (formats/note.py) adds its begin and end, its frame and whether it
was simulated, so an import restores it event for event and slice for slice. Gripper, truth, control and dots are left
out where the format cannot store them, and the export reports this. Tables and data sets for policies store a trial:
the recording and everything computed from it, one row per slice or frame, without single events.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from evetac_cli import plugins
from evetac_cli.errors import InputError
from evetac_cli.formats import calibration_files
from evetac_cli.formats.write import (
    event_files,
    write_event_images,
    write_mcap,
    write_table,
)
from evetac_cli.formats.write.lerobot import write_lerobot
from evetac_cli.formats.write.slice_columns import Opener, WrittenFolder, recording_alone
from evetac_cli.jobs import Progress, require_possible_name, silent
from evetac_cli.kernels.event_representation import Kind
from evetac_cli.store.files import stem
from evetac_cli.store.hdf5.disk import check_free, taking_the_place_of
from evetac_cli.store.made_folders import new_folder
from evetac_cli.store.recordings.read import Recording


class ExportFormat(NamedTuple):
    """A row of the table: the file endings (the usual one first), the writer, and whether the files store events.

    - of_trial: `write` gets the TrialFiles instead of the Recording, and returns what it could not show.
    - write_folder: the function that writes a data set of many trials.
    - holds: groups and datasets of a recording that the files store in addition to its events.
    - takes: the parameters of `export` that have an effect. All except `model` are passed to the writer; `model`
      selects the detector whose slip probability is among the TrialFiles.

    A plug-in provides a row of the same type.
    """

    suffixes: tuple[str, ...]
    write: Callable[..., list[str] | None] | None
    events: bool = True
    of_trial: bool = False
    write_folder: Callable[..., WrittenFolder] | None = None
    holds: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()


TABLE: dict[str, Any] = {"events": False, "of_trial": True, "takes": ("model",)}
OF_IMAGES = ("fps", "size")  # parameters of every event image format

OF_LEROBOT = ("fps", "per_frame", "test_objects", "task", "tactile_key", "event_frames", "size")


def _images(kind: Kind, *takes: str) -> ExportFormat:
    return ExportFormat(
        (f".{kind}.npz", ".npz"), write_event_images.writer(kind), events=False, takes=(*OF_IMAGES, *takes)
    )


FORMATS = {
    "aedat4": ExportFormat((".aedat4",), event_files.write_aedat4),
    "dsec": ExportFormat((".dsec.h5", ".h5", ".hdf5"), event_files.write_dsec),
    "text": ExportFormat((".txt",), event_files.write_text),
    "raw": ExportFormat((".raw",), event_files.write_raw),
    "mcap": ExportFormat((".mcap",), write_mcap.write, of_trial=True, holds=write_mcap.HOLDS),
    "calibration": ExportFormat((".calibration.json", ".json", ".pkl"), calibration_files.write, events=False),
    "parquet": ExportFormat((".parquet",), write_table.write_parquet, **TABLE, write_folder=write_table.write_data_set),
    "csv": ExportFormat((".csv",), write_table.write_csv, **TABLE),
    "frames": _images("frames", "window_ms", "polarity"),
    "histogram": _images("histogram", "window_ms", "bins", "polarity"),
    "voxels": _images("voxels", "window_ms", "bins"),
    "surface": _images("surface", "decay_ms", "polarity"),
    "lerobot": ExportFormat(
        (".parquet", ".json", ".mp4", ".md"),
        None,
        **TABLE | {"takes": ("model", *OF_LEROBOT)},
        write_folder=write_lerobot.write,
    ),
}
# Groups and datasets of a recording that an event file cannot store.
LEFT_OUT = ("gripper", "truth", "control", "capture", "marks", "streams", "sensor/dot_xy_px", "sensor/window_px")


def named_format(name: str) -> ExportFormat:
    """Return the row of a format, built in or from a plug-in; raise InputError if none has this name."""
    if name in FORMATS:
        return FORMATS[name]
    plugin = plugins.by_name(plugins.EXPORTERS, name)
    if plugin is None:
        expected = ", ".join((*FORMATS, *plugins.usable(plugins.EXPORTERS)))
        raise InputError("unknown format", where="--format", expected=expected, found=name)
    row = plugin.load(ExportFormat)
    plugin.use()
    return row


def is_folder(format_: str, out: Path | None) -> bool:
    """Whether all recordings go into one folder: the format writes only folders, or `out` is not a file name."""
    row = named_format(format_)
    if row.write_folder is None:
        return False
    return row.write is None or (out is not None and out.suffix.lower() not in row.suffixes)


def target_path(source: Path, format_: str, out: Path | None) -> Path:
    """Return `<name><ending>` next to the recording or in the folder `out`, or `out` if it has such an ending."""
    suffixes = named_format(format_).suffixes
    if out is None:
        return source.with_name(stem(source) + suffixes[0])
    if out.is_dir() or not out.suffix:
        return out / (stem(source) + suffixes[0])
    if out.suffix.lower() not in {Path("x" + suffix).suffix for suffix in suffixes}:
        expected = f"a name that ends in {' or '.join(suffixes)}, or a folder"
        raise InputError("the output's name does not fit the format", where=str(out), expected=expected)
    return out


def export(
    source: Path,
    format_: str,
    target: Path,
    options: Mapping[str, Any] = MappingProxyType({}),
    *,
    force: bool = False,
    progress: Progress = silent,
    opened: Opener = recording_alone,
    together: ExitStack | None = None,
) -> dict[str, Any]:
    """Write a recording in another format, completely or not at all; return what was written and what was left out.

    options: of the format. opened: opens the files of the recording's trial. together: the target appears when this
    closes, with those of other recordings. Raises InputError if the target exists and `force` is not set, or if the
    recording lacks data that the format requires.
    """
    require_possible_name(target)
    check_free(target, force=force)
    row = named_format(format_)
    assert row.write is not None
    with ExitStack() as alone, (opened if row.of_trial else recording_alone)(source) as files:
        recording = files.recording
        if target.exists() and target.samefile(source):
            raise InputError("the output would replace the recording", where=str(target))
        place = taking_the_place_of(target, target.suffix, partial(check_free, target, force=force))
        temporary = (together or alone).enter_context(place)
        left_out = row.write(files if row.of_trial else recording, temporary, progress, **options) or []
        size = temporary.stat().st_size
        if row.events:
            left_out += _left_out(recording, row.holds)
        return {
            "recording": str(source),
            "output": str(target),
            "format": format_,
            "events": recording.event_count if row.events else None,
            "slices": len(recording) if row.events or row.takes else None,
            "size_bytes": size,
            "left_out": ("; " if row.of_trial else " ").join(left_out) or None,
            "simulated": files.simulated,
        }


def _left_out(recording: Recording, holds: tuple[str, ...]) -> list[str]:
    """Return the contents of a recording that an event file does not store: whole groups, or single datasets."""
    names: list[str] = []
    for group in LEFT_OUT:
        paths = [path for path in recording.contents() if path == group or path.startswith(f"{group}/")]
        left = [path for path in paths if path not in holds and group not in holds]
        names += [group] if left and left == paths else left
    return names


def export_folder(
    sources: Sequence[Path],
    format_: str,
    folder: Path,
    options: Mapping[str, Any],
    *,
    progress: Progress = silent,
    opened: Opener = recording_alone,
) -> dict[str, Any]:
    """Write many recordings as one data set in a folder, completely or not at all; return what was written and omitted.

    options: of the format. Raises InputError if the folder has anything in it.
    """
    require_possible_name(folder)
    row = named_format(format_)
    assert row.write_folder is not None
    with new_folder(folder) as temporary:
        written = row.write_folder(sources, opened, temporary, progress, **options)
        sizes = [path.stat().st_size for path in temporary.rglob("*") if path.is_file()]
    return {
        "recordings": len(sources),
        "output": str(folder),
        "format": format_,
        **written.figures,
        "files": len(sizes),
        "size_bytes": sum(sizes),
        "left_out": "; ".join(written.left_out) or None,
        "simulated": written.simulated,
    }
