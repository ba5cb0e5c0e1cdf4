"""Splits of trajectories into training and evaluation, which never overlap, and are by object on request."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.store.layout.ancestry import trajectories
from evetac_cli.store.layout.provenance import Header


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
        raise InputError(
            f"a recording is both trained on and {what}",
            where=str(path),
            found=f"{len(shared)} such files, this one from the recording {min(common)[:12]}",
            hint="split by trajectory: use every recording in one set only",
        )


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
        raise InputError(
            "there are too few objects for this number of folds",
            where="--folds",
            expected=f"2 to {len(objects)}, or 0" if len(objects) > 1 else "0",
            found=f"{folds}, and the objects {', '.join(objects)}",
        )
    shares = [set(objects[first::folds]) for first in range(folds)]
    left_out = [
        Fold([i for i in training if names[i] not in share], [i for i in everything if names[i] in share])
        for share in shares
    ]
    return [*left_out, Fold([*training], [])]
