"""Which trajectories a model learns from and which it is judged on: never the same, by object where that is wanted."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.store.provenance import Header


def object_of(header: Header) -> str:
    """The object of the recording that a file descends from, or `unknown`."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "object" in ancestor["parameters"]:
            return str(ancestor["parameters"]["object"])
    return "unknown"


def recordings_of(header: Header) -> set[str]:
    """Ids of all recordings that a file descends from."""
    everybody = {header["id"]: header, **header["history"]}
    return {id_ for id_, ancestor in everybody.items() if ancestor["kind"] == "recording"}


def check_disjoint(learn: list[Header], held_out: list[Header], what: str, paths: Sequence[Path]) -> None:
    """Refuse to judge a model on a recording that it was trained on; `paths` are the files held out."""
    seen = set().union(*(recordings_of(header) for header in learn))
    shared = [
        (path, common) for path, header in zip(paths, held_out, strict=True) if (common := recordings_of(header) & seen)
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
    """One network to train: the inputs (their places in a job) that it learns, and those that it then judges."""

    learned: list[int]
    judged: list[int]


def folds_of(headers: Sequence[Header], learn: int, folds: int) -> list[Fold]:
    """The networks to train; the last one is kept, and what all of them judge chooses its checkpoint and threshold.

    The first `learn` of the headers are of files to train on, the others of files to judge. InputError if there are
    not as many objects as `folds`; without folds the objects do not matter.

    Why so: a detector tells slips of objects that it was trained on so well that many thresholds are nearly as good,
    and the chosen one is too low for other objects. So other networks each leave out some of the objects and judge
    these; that costs as many trainings more.
    """
    everything, known = range(len(headers)), range(learn)
    if not folds:
        return [Fold([*known], [*everything[learn:]])]
    of = [object_of(header) for header in headers]
    objects = sorted(set(of), key=lambda name: (len(name), name))
    if not 2 <= folds <= len(objects):
        raise InputError(
            "not so many shares of the objects can be left out",
            where="--folds",
            expected=f"2 to {len(objects)}, or 0" if len(objects) > 1 else "0",
            found=f"{folds}, and the objects {', '.join(objects)}",
        )
    shares = [set(objects[first::folds]) for first in range(folds)]
    apart = [
        Fold([i for i in known if of[i] not in share], [i for i in everything if of[i] in share]) for share in shares
    ]
    return [*apart, Fold([*known], [])]
