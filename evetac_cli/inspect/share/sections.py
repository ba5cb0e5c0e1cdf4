"""The sections of cards: the splits of a data set, its limitations, and how to cite it.

The limitations are made from the files: how much is simulated, what they cover, what is estimated. No author is
invented: the authors of the paper are those of CITATION.cff, and those of a data set or model are given by the person
who shares it, or not named.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.formats.write.hub_card import inline
from evetac_cli.jobs import Progress
from evetac_cli.names import __version__
from evetac_cli.store.data_set import FileRow
from evetac_cli.store.files import StageFile, stem
from evetac_cli.text_files import as_utf8

# The Hub's names of splits, and the names of folders: those that the Hub recognizes, and those in evetac's docs.
SPLITS = {
    "train": ("train", "training", "learn"),
    "validation": ("validation", "valid", "val", "dev", "choose"),
    "test": ("test", "testing", "eval", "evaluation", "unseen"),
}
OTHER = "other"
# The facts in docs/evidence/likeness.md that the simulator does not match; a test compares the two lists.
NOT_LIKE = ("official-2024", "official-2026", "paper-on-slip", "lost-regularised", "force-by-papers-tracker")
UNLIKE = (
    "The simulated sensor is known to differ from the real one. In simulation, an object that slides over the gel drags"
    " along dots that the published trackers keep, and under a slow shear the paper's tracker loses them, which spoils"
    " shear force. Also, no dot radius fits both the paper's equations and the"
    f" published code. These are the facts {', '.join(f'`{name}`' for name in NOT_LIKE)} in docs/evidence/likeness.md"
    " of evetac, which lists all public facts and how well the simulator matches them. `evetac evaluate likeness`"
    " compares recordings with the same facts."
)
# The estimates of each kind of file: its columns in the tables, and the estimator.
ESTIMATED = {
    "tracks": "`dot_*_px`, `lost_*` and `events_per_dot_*`, by a dot tracker (files by preset: {how})",
    "labels": "`label` and with it the onset of slip (files by method: {how})",
    "features": "`displacement_*_px`, from such tracks",
    "touch": "`touch_*`, by a model of the gel, with standard deviations `_sd`",
}
HOW = {"tracks": "preset", "labels": "method"}  # the parameter that names the estimator
COVERED = ("sensor", "object", "scene")
# Copied from CITATION.cff, which is not part of an installation.
PAPER = """```bibtex
@article{funk2024evetac,
  title = {{Evetac: An Event-based Optical Tactile Sensor for Robotic Manipulation}},
  author = {Funk, Niklas and Helmut, Erik and Chalvatzaki, Georgia and Calandra, Roberto and Peters, Jan},
  journal = {IEEE Transactions on Robotics},
  year = {2024}
}
```"""


class SharedTrial(NamedTuple):
    """A recording to share: its name (without ending) and its split in the data set, and its file."""

    name: str
    split: str
    source: Path


def trials_of(folder: Path, recordings: Sequence[FileRow]) -> list[SharedTrial]:
    """Return the recordings of a folder with their splits; all are `train` if no folder names a split.

    If some are in such folders, the others get the split `other`.
    """
    found = [split_of(row.path) for row in recordings]
    rest = OTHER if any(found) else "train"
    return [
        SharedTrial(
            as_utf8((Path(row.path).parent / stem(Path(row.path))).as_posix()), split or rest, folder / row.path
        )
        for row, split in zip(recordings, found, strict=True)
    ]


def split_of(path: str) -> str | None:
    """Return the split that a folder of this path names; None if none does."""
    split_by_name = {name: split for split, names in SPLITS.items() for name in names}
    return next((split_by_name[part.lower()] for part in Path(path).parts[:-1] if part.lower() in split_by_name), None)


def held_out(rows: Sequence[tuple[str, FileRow]]) -> str:
    """Return a text on the splits of (split, recording): the objects that training data lack."""
    splits = list(dict.fromkeys(split for split, _ in rows))
    if len(splits) < 2:
        return (
            "The data are not split into training and test data: all trials are `train`. To evaluate a method, hold out"
            " whole objects, because trials of the same object are similar."
        )
    sentences = []
    learned = _known_objects(rows, "train")
    for name in ("validation", "test"):
        only = sorted(_known_objects(rows, name) - learned, key=lambda value: (isinstance(value, str), value))
        if learned and only:
            sentences.append(f"`{name}` has objects that are not in `train` ({', '.join(map(str, only))}).")
    ids = [{row.recipe_id for split, row in rows if split == one} for one in splits]
    twice = len(set().union(*(a & b for at, a in enumerate(ids) for b in ids[at + 1 :])))
    if twice:
        sentences.append(f"**{twice} recording{' is' if twice == 1 else 's are'} in two splits.**")
    return " ".join(sentences) or f"The splits are {', '.join(splits)}."


def _known_objects(rows: Sequence[tuple[str, FileRow]], split: str) -> set[int | str]:
    return {row.object for one, row in rows if one == split and row.object is not None}


@dataclass
class DataSetFacts:
    """Facts from the headers and a few datasets of all files of a folder."""

    how: dict[str, Counter[str]] = field(default_factory=dict)  # kind -> estimator -> number of files
    abstained: int = 0  # labels that could not identify an onset
    with_losses: int = 0  # recordings with lost slices

    def add(self, file: StageFile) -> None:
        """Add the facts of a file."""
        if file.kind in ESTIMATED:
            how = str(file.header["parameters"].get(HOW.get(file.kind, ""), "unknown"))[:40]
            self.how.setdefault(file.kind, Counter())[how] += 1
        self.abstained += file.kind == "labels" and file.has("abstained") and int(file.read("abstained"))
        self.with_losses += file.has("capture/lost_slices") and file.length("capture/lost_slices") > 0


def look(folder: Path, rows: Sequence[FileRow], progress: Progress) -> DataSetFacts:
    """Open all files of a folder and return their facts."""
    contents = DataSetFacts()
    for number, row in enumerate(rows):
        progress(number, len(rows), "files")
        with StageFile(folder / row.path) as file:
            file.check()  # a damaged file must not be shared
            contents.add(file)
    return contents


def limitations(contents: DataSetFacts, trials: Sequence[FileRow], split: Sequence[tuple[str, FileRow]]) -> list[str]:
    """Return the section Limitations of a card.

    trials: a row for each trial; split: each recording with its part of the data set.
    """
    simulated = sum(bool(row.simulated) for row in trials)
    covered = {what: {value for row in trials if (value := getattr(row, what)) is not None} for what in COVERED}
    lines = [_simulated(simulated, len(trials)), _covered(covered, len(trials))]
    if split:
        lines.append(held_out(split))
    estimated = [
        words.format(how=", ".join(f"{how} {count}" for how, count in sorted(contents.how[kind].items())))
        for kind, words in ESTIMATED.items()
        if kind in contents.how
    ]
    if estimated:
        lines.append(f"Estimated, not measured: {'; '.join(estimated)}.")
    if contents.abstained:
        lines.append(f"In {contents.abstained} trials the onset could not be labelled; `label` is -1 around it.")
    if contents.with_losses:
        lines.append(
            f"{contents.with_losses} recordings lost slices, which are empty and listed in `capture/lost_slices`."
        )
    if simulated:
        lines.append(UNLIKE)
    return ["## Limitations", "\n".join(f"- {line}" for line in lines)]


def _simulated(simulated: int, trials: int) -> str:
    truth = (
        "`truth_*` and `truth/` are ground truth, which only a simulator has: do not use them as inputs of a method for"
        " a real sensor."
    )
    if not simulated:
        return "According to the files, no trial is simulated."
    if simulated < trials:
        return f"{simulated} of {trials} trials are simulated (column `simulated`); the others are not. {truth}"
    return f"All trials are simulated: no real sensor, object or gripper was involved. {truth}"


def _covered(covered: Mapping[str, set[Any]], trials: int) -> str:
    parts = [
        f"{len(values)} {what}{'' if len(values) == 1 else 's'}" if values else f"no known {what}"
        for what, values in covered.items()
    ]
    one = [what for what, values in covered.items() if len(values) == 1]
    alone = f" The data cannot show how well a method generalizes to another {' or '.join(one)}." if one else ""
    return f"{trials} trial{'' if trials == 1 else 's'}: {', '.join(parts)}.{alone}"


def citation(author: str | None, what: str) -> list[str]:
    """Return the section Citation of a card: the paper on sensor and methods, and the authors of data set or model."""
    authors = f"Authors of this {what}: {inline(author)}." if author else f"The authors of this {what} are not named."
    return ["## Citation", "The paper on the sensor and the methods:", PAPER, authors]


def made_with() -> list[str]:
    """Return the section Version of a card."""
    return ["## Version", f"Card written by evetac {__version__}."]
