"""Files that belong together: those named by a flag, and those made from the same recording."""

import glob
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evetac_cli.errors import MADE_BY, InputError, made_by
from evetac_cli.resources import SHIPPED, model_file
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import Recording, open_recording

BY_SLICE = {
    "labels": "label",
    "tracks": "dot_xy_px",
    "features": "displacement_px",
}  # datasets with a row for every slice


def named_files(path_or_glob: Path | str | None, kind: str, flag: str) -> list[Path]:
    """Return the files of a kind named by a flag, sorted: a file, a folder, a glob, or the pretrained `shipped`.

    InputError if there are none.
    """
    pattern = str(path_or_glob or "")
    if kind == "model" and pattern:
        pattern = str(model_file(pattern, flag))
    if pattern and Path(pattern).is_dir():
        pattern = f"{pattern}/*.{kind}.h5"
    is_file = bool(pattern) and Path(pattern).is_file()  # its name may contain special characters of globs
    files = [Path(pattern)] if is_file else [Path(name) for name in sorted(glob.glob(pattern))]
    if not files:
        raise InputError(
            "no such file" if pattern else f"no {kind} file is given",
            where=flag,
            expected=f"a {kind} file, a folder of them, or a glob" + (f"; or {SHIPPED}" if kind == "model" else ""),
            found=str(path_or_glob or ""),
            hint=made_by(kind),
        )
    return files


def check_made_from(file: StageFile, recording: StageFile) -> None:
    """Raise InputError unless a file was made from exactly this recording; an equal name is not enough."""
    if recording.header["id"] in file.header["parents"]:
        rows, slices = file.length(BY_SLICE[file.kind]), recording.length("ms_to_idx") - 1
        if rows == slices:
            return
        raise InputError(
            f"the {file.kind} differ from the recording in the number of slices",
            where=str(file.path),
            expected=f"{slices}, as {recording.path}",
            found=str(rows),
            hint=f"evetac {MADE_BY[file.kind]} --force {recording.path}",
        )
    raise InputError(
        f"the {file.kind} belong to another recording",
        where=str(file.path),
        expected=f"made from {recording.path} (id {recording.header['id'][:12]})",
        found=f"made from id {', '.join(parent[:12] for parent in file.header['parents'])}",
        hint=f"evetac {MADE_BY[file.kind]} --force {recording.path}" if file.kind in BY_SLICE else "",
    )


@contextmanager
def recording_with_truth(file: StageFile) -> Iterator[Recording]:
    """Open the simulated recording from which a file was made: next to it, or in the folder above, as for `track-rgb`.

    InputError if it is missing, is another recording or has no ground truth.
    """
    path = output_path(file.path, "recording", None)
    above = path.parent.resolve().parent / path.name
    path = above if above.exists() and not path.exists() else path
    with open_recording(path) as recording:
        check_made_from(file, recording)
        if not recording.has("truth"):
            raise InputError(
                "the recording has no truth: only simulated recordings have it",
                where=str(path),
                hint="evetac record --scene NAME simulates one",
            )
        yield recording
