"""Which trajectories a model is trained on and which it is evaluated on: never the same, by object on request."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.store.layout.provenance import Header


def object_name(header: Header) -> str:
    """The object of the recording that a file descends from, or `unknown`."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "object" in ancestor["parameters"]:
            return str(ancestor["parameters"]["object"])
    return "unknown"


def sensor_name(header: Header) -> str:
    """The sensor of the recording that a file descends from, or `unknown`."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "sensor" in ancestor["parameters"]:
            return str(ancestor["parameters"]["sensor"])
    return "unknown"


def recording_ids(header: Header) -> set[str]:
    """Ids of all recordings that a file descends from."""
    lineage = {header["id"]: header, **header["history"]}
    return {id_ for id_, ancestor in lineage.items() if ancestor["kind"] == "recording"}


def check_disjoint(learn: list[Header], held_out: list[Header], what: str, paths: Sequence[Path]) -> None:
    """InputError where a held-out file comes from a recording that was trained on; `paths` are the held-out files."""
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
            hint="split by trajectory: every recording belongs to one side",
        )


class Fold(NamedTuple):
    """One network to train: which inputs of the job it is trained on, and on which it is evaluated (their indices)."""

    trained_on: list[int]
    evaluated_on: list[int]


def make_folds(headers: Sequence[Header], learn: int, folds: int) -> list[Fold]:
    """The networks to train. The last one is the model; the evaluations of all choose its checkpoint and threshold.

    The first `learn` of the headers are of files to train on, the others of files to evaluate on. InputError if there
    are fewer objects than `folds`; with 0 folds the objects do not matter.

    Why so: on objects that it was trained on a detector is so good that many thresholds are nearly as good, and the
    chosen one is too low for other objects. So further networks are trained, each without some of the objects, and
    evaluated on these; that costs as many trainings more.
    """
    everything, training = range(len(headers)), range(learn)
    if not folds:
        return [Fold([*training], [*everything[learn:]])]
    names = [object_name(header) for header in headers]
    objects = sorted(set(names), key=lambda name: (len(name), name))
    if not 2 <= folds <= len(objects):
        raise InputError(
            "there are not so many groups of objects to leave out",
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
