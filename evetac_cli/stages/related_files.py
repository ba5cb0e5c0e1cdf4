"""Files that belong together: those named by a flag, and those made from the same recording.

Files for training and those for evaluation never have a recording in common, and on request no object.
"""

import glob
import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import MADE_BY, EvetacError, InputError, made_by
from evetac_cli.resources import SHIPPED, model_file
from evetac_cli.store.files import StageFile, header_of, output_path
from evetac_cli.store.layout.ancestry import trajectories
from evetac_cli.store.layout.provenance import Header
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
        message = f"the {file.kind} differ from the recording in the number of slices"
        expected, found = f"{slices}, as {recording.path}", str(rows)
    else:
        message = f"the {file.kind} belong to another recording"
        expected = f"made from {recording.path} (id {recording.header['id'][:12]})"
        found = f"made from id {', '.join(parent[:12] for parent in file.header['parents'])}"
    hint = f"evetac {MADE_BY[file.kind]} --force {recording.path}" if file.kind in BY_SLICE else ""
    raise InputError(message, where=str(file.path), expected=expected, found=found, hint=hint)


def check_same(what: str, values: Sequence[Any], paths: Sequence[Path]) -> None:
    """Raise InputError unless the values of all files are equal; what: their name, in plural."""
    odd = next((number for number, value in enumerate(values) if value != values[0]), None)
    if odd is not None:
        expected, found = f"{values[0]}, as in {paths[0]}", str(values[odd])
        raise InputError(f"the files have different {what}", where=str(paths[odd]), expected=expected, found=found)


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
            found = f"none in {', '.join(map(str, folders[:MOST_NAMED]))}{more}"
            hint = hint or f"move its {self._kind} to one of these folders"
            raise InputError(f"no {self._kind} of this file", where=str(file.path), found=found, hint=hint)
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


def no_truth(path: Path, hint: str = "evetac record --scene NAME simulates one") -> InputError:
    """Return the error for a recording without ground truth."""
    return InputError("the recording has no truth: only simulated recordings have it", where=str(path), hint=hint)


def missing_truth(path: Path, needed: str) -> InputError:
    """Return the error for the recording of another simulator's dots without some ground truth."""
    hint = "add it to the file of --from-dots" if needed != "truth/slid_px" else "only evetac's own scenes know it"
    return InputError("the truth is incomplete", where=str(path), expected=needed, found="none", hint=hint)


@contextmanager
def recording_with_truth(file: StageFile, needed: str = "truth/shear_force_n") -> Iterator[Recording]:
    """Open the simulated recording from which a file was made.

    InputError if it is missing, is another recording or its ground truth lacks the needed dataset.
    """
    path = Origins("recording").must_find(file)
    with open_recording(path) as recording:
        check_made_from(file, recording)
        if not recording.has(needed):
            raise no_truth(path) if not recording.has("truth") else missing_truth(path, needed)
        yield recording


def object_name(header: Header) -> str:
    """Return the object of the recording from which a file was made, or `unknown`."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "object" in ancestor["parameters"]:
            return str(ancestor["parameters"]["object"])
    return "unknown"


class RecordedSensor(NamedTuple):
    """The name of a sensor, and its values as far as the recipe of a recording has them."""

    name: str
    values: dict[str, Any]


UNKNOWN_SENSOR = RecordedSensor("unknown", {})


def sensor_of(header: Header) -> RecordedSensor:
    """Return the sensor of the recording from which a file was made; its name is `unknown` if the recipe has none."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "sensor" in ancestor["parameters"]:
            return RecordedSensor(str(ancestor["parameters"]["sensor"]), ancestor["parameters"].get("sensor_row") or {})
    return UNKNOWN_SENSOR


def sensor_names(sensors: Sequence[RecordedSensor]) -> list[str]:
    """Return the name of each sensor.

    Different sensors of one name, such as sensor files without `name`, get the values that differ in their names.
    """
    named = [(sensor.name, sensor.values) for sensor in sensors]
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, row in named:
        of_name = rows.setdefault(name, [])
        of_name += [] if row in of_name else [row]
    differ = {
        name: [
            key
            for key in dict.fromkeys(key for row in of_name for key in row)
            if any(row.get(key) != of_name[0].get(key) for row in of_name)
        ]
        for name, of_name in rows.items()
    }
    return [
        ", ".join([name, *(f"{key} {_text(row[key])}" for key in differ[name] if key in row)]) for name, row in named
    ]


def _text(value: Any) -> str:
    """Return a value in a name; a list or a table, which would be too long, as a digest."""
    if isinstance(value, (list, dict)):
        return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:6]
    return f"{value:g}" if isinstance(value, float) else str(value)


def recording_ids(header: Header) -> set[str]:
    """Return the ids of all recordings from which a file was made, also of those that a trained one was made from."""
    lineage = {header["id"]: header, **header["history"]}
    rows = trajectories(lineage.values())
    ids = {id_ for id_, ancestor in lineage.items() if ancestor["kind"] == "recording"}
    return ids | {row["recording"] for row in rows if row["recording"] is not None}


def check_disjoint(learn: list[Header], held_out: list[Header], what: str, paths: Sequence[Path]) -> None:
    """Raise InputError if a held-out file comes from a training recording; `paths` are the held-out files."""
    seen = set().union(*(recording_ids(header) for header in learn))
    shared = [
        (path, common) for path, header in zip(paths, held_out, strict=True) if (common := recording_ids(header) & seen)
    ]
    if shared:
        path, common = shared[0]
        found = f"{len(shared)} such files, this one from the recording {min(common)[:12]}"
        raise InputError(f"a recording is both trained on and {what}", where=str(path), found=found)


class Fold(NamedTuple):
    """A network to train: indices of the job's inputs for its training and for its evaluation."""

    trained_on: list[int]
    evaluated_on: list[int]


def make_folds(headers: Sequence[Header], learn: int, folds: int) -> list[Fold]:
    """Return the networks to train. The last is the model; all evaluations together choose checkpoint and threshold.

    The first `learn` headers are those of training files, the others those of evaluation files. InputError if there are
    fewer objects than `folds`; with 0 folds the objects do not matter.

    On its training objects a detector is so good that many thresholds are nearly equal, and the chosen one is too low
    for other objects. So further networks are trained, each without some of the objects, and evaluated on these
    objects. This needs `folds` more trainings.
    """
    everything, training = range(len(headers)), range(learn)
    if not folds:
        return [Fold([*training], [*everything[learn:]])]
    names = [object_name(header) for header in headers]
    objects = sorted(set(names), key=lambda name: (len(name), name))
    if not 2 <= folds <= len(objects):
        expected, found = f"2 to {len(objects)}, or 0", f"{folds}, and the objects {', '.join(objects)}"
        raise InputError("there are too few objects", where="--folds", expected=expected, found=found)
    shares = [set(objects[first::folds]) for first in range(folds)]
    left_out = [
        Fold([i for i in training if names[i] not in share], [i for i in everything if names[i] in share])
        for share in shares
    ]
    return [*left_out, Fold([*training], [])]
