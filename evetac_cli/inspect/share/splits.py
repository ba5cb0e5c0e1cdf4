"""Assign trials to training, validation or test data, by the name of their folder."""

from collections.abc import Sequence
from pathlib import Path

from evetac_cli.formats.write.hub_tables import SharedTrial
from evetac_cli.store.files import stem
from evetac_cli.store.index import IndexRow
from evetac_cli.text_files import as_utf8

# The Hub's names of splits, and the names of folders: those that the Hub recognizes, and those in evetac's docs.
SPLITS = {
    "train": ("train", "training", "learn"),
    "validation": ("validation", "valid", "val", "dev", "choose"),
    "test": ("test", "testing", "eval", "evaluation", "unseen"),
}
OTHER = "other"


def trials_of(folder: Path, recordings: Sequence[IndexRow]) -> list[SharedTrial]:
    """Return the recordings of a folder with their splits; all are `train` if no folder names a split.

    If some are in such folders, the others get the split `other`.
    """
    found = [split_of(row.path) for row in recordings]
    rest = OTHER if any(found) else "train"
    return [
        SharedTrial(
            as_utf8((Path(row.path).parent / stem(Path(row.path))).as_posix()),
            as_utf8(row.path),
            folder / row.path,
            split or rest,
        )
        for row, split in zip(recordings, found, strict=True)
    ]


def split_of(path: str) -> str | None:
    """Return the split that a folder of this path names; None if none does."""
    split_by_name = {name: split for split, names in SPLITS.items() for name in names}
    return next((split_by_name[part.lower()] for part in Path(path).parts[:-1] if part.lower() in split_by_name), None)


def held_out(rows: Sequence[tuple[str, IndexRow]]) -> str:
    """Return a text on the splits of (split, recording): the objects and sensors that training data lack."""
    splits = list(dict.fromkeys(split for split, _ in rows))
    if len(splits) < 2:
        return (
            "The data are not split into training and test data: all trials are `train`. To evaluate a method, hold out"
            " whole objects, because trials of the same object are similar."
        )
    sentences = []
    for name in ("validation", "test"):
        if name not in splits or "train" not in splits:
            continue
        parts = []
        for what in ("object", "sensor"):
            mine, learned = (_known_values(rows, split, what) for split in (name, "train"))
            only = sorted(mine - learned, key=lambda value: (isinstance(value, str), value))
            if not mine:
                parts.append(f"unknown {what}s")
            elif only:
                parts.append(f"{what}s that are not in `train` ({', '.join(map(str, only))})")
            else:
                parts.append(f"only {what}s that are also in `train`")
        sentences.append(f"`{name}` has {' and '.join(parts)}.")
    ids = [{row.recipe_id for split, row in rows if split == one} for one in splits]
    twice = len(set().union(*(a & b for at, a in enumerate(ids) for b in ids[at + 1 :])))
    if twice:
        sentences.append(f"**{twice} recording{' is' if twice == 1 else 's are'} in two splits.**")
    return " ".join(sentences) or f"The splits are {', '.join(splits)}."


def _known_values(rows: Sequence[tuple[str, IndexRow]], split: str, what: str) -> set[int | str]:
    return {value for one, row in rows if one == split and (value := getattr(row, what)) is not None}
