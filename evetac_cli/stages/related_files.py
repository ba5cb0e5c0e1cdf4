"""Files that belong together: those named by a flag, and those made from the same recording."""

import glob
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evetac_cli.errors import MADE_BY, EvetacError, InputError, made_by
from evetac_cli.resources import SHIPPED, model_file
from evetac_cli.store.files import StageFile, header_of, output_path
from evetac_cli.store.recordings.read import Recording, open_recording

BY_SLICE = {
    "labels": "label",
    "tracks": "dot_xy_px",
    "features": "displacement_px",
}  # datasets with a row for every slice

MOST_SEARCHED = 1000  # folders, and files in each, in which an origin is searched
MOST_NAMED = 5  # folders in an error
OTHER_FOLDER = "give the folder of the recordings with --recordings"  # hint of commands that have this flag


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


class Origins:
    """Finds the files of a kind from which other files were made, by their ids; one search serves many files.

    It looks in the folder of the file, in the one above, and in that one's sub-folders; or in a given folder and its
    sub-folders. A file of the same name is tried first, so that usually no other is opened.
    """

    def __init__(self, kind: str, folder: Path | None = None) -> None:
        self._kind = kind
        self._folder = folder
        self._paths: dict[Path, dict[str, Path]] = {}  # folder -> id -> path

    def find(self, file: StageFile) -> Path | None:
        """Return the path of the file's origin; else that of a file of its name, which is another one; else None."""
        wanted = set(file.header["parents"])
        named = output_path(file.path, self._kind, self._folder)
        if self._id(named) in wanted:
            return named
        folders = self._folders(file)
        for folder in folders:
            if self._id(folder / named.name) in wanted:
                return folder / named.name
        for folder in folders:
            if folder not in self._paths:
                some = itertools.islice(folder.glob(f"*.{self._kind}.h5"), MOST_SEARCHED)
                self._paths[folder] = {id_: path for path in some if (id_ := self._id(path)) is not None}
            for id_ in wanted & self._paths[folder].keys():
                return self._paths[folder][id_]
        return named if named.exists() else None

    def must_find(self, file: StageFile, hint: str = "") -> Path:
        """Return the same path as `find`; InputError with the folders that were searched if there is none."""
        path = self.find(file)
        if path is None:
            folders = self._folders(file)
            more = f" and {len(folders) - MOST_NAMED} more" if len(folders) > MOST_NAMED else ""
            raise InputError(
                f"no {self._kind} of this file",
                where=str(file.path),
                expected=f"the {self._kind} from which it was made, under any name",
                found=f"none in {', '.join(map(str, folders[:MOST_NAMED]))}{more}",
                hint=hint or f"move its {self._kind} to one of these folders",
            )
        return path

    def _folders(self, file: StageFile) -> list[Path]:
        """Return the folders that are searched, at most MOST_SEARCHED."""
        own = file.path.parent
        top = own / os.pardir if self._folder is None else self._folder
        below = (path for path in sorted(top.glob("*/")) if path.is_dir())
        first = [own, top] if self._folder is None else [top]
        every = (Path(os.path.relpath(path)) for path in (*first, *itertools.islice(below, MOST_SEARCHED)))
        return list(dict.fromkeys(every))

    def _id(self, path: Path) -> str | None:
        """Return the id of a file of the kind; None if it is missing or cannot be read."""
        try:
            return header_of(path, self._kind)["id"] if path.is_file() else None
        except (EvetacError, OSError):
            return None


@contextmanager
def recording_with_truth(file: StageFile) -> Iterator[Recording]:
    """Open the simulated recording from which a file was made.

    InputError if it is missing, is another recording or has no ground truth.
    """
    path = Origins("recording").must_find(file)
    with open_recording(path) as recording:
        check_made_from(file, recording)
        if not recording.has("truth"):
            raise InputError(
                "the recording has no truth: only simulated recordings have it",
                where=str(path),
                hint="evetac record --scene NAME simulates one",
            )
        yield recording
