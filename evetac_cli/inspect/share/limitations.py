"""The limitations of a data set, from its files: how much is simulated, what it covers, what is estimated."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evetac_cli.inspect.share.splits import held_out
from evetac_cli.jobs import Progress
from evetac_cli.store.files import StageFile
from evetac_cli.store.index import IndexRow

# The facts in docs/likeness.md that the simulator does not match; a test compares the two lists.
NOT_LIKE = ("official-2024", "official-2026", "paper-on-slip", "lost-regularised", "force-by-papers-tracker")
UNLIKE = (
    "The simulated sensor is known to differ from the real one. In simulation, an object that slides over the gel drags"
    " along dots that the published trackers keep, and under a slow shear the paper's tracker loses them, which spoils"
    " shear force. Also, no dot radius fits both the paper's equations and the"
    f" published code. These are the facts {', '.join(f'`{name}`' for name in NOT_LIKE)} in docs/likeness.md of evetac,"
    " which lists all public facts and how well the simulator matches them. `evetac evaluate likeness` compares"
    " recordings with the same facts."
)
# The estimates of each kind of file: its columns in the tables, and the estimator.
ESTIMATED = {
    "tracks": "`dot_*_px`, `lost_*` and `events_per_dot_*`, by a dot tracker (files by preset: {how})",
    "labels": "`label` and with it the onset of slip (files by method: {how})",
    "features": "`displacement_*_px`, from such tracks",
    "touch": "`touch_*`, by a model of the gel, with standard deviations `_sd`",
}
HOW = {"tracks": "preset", "labels": "method"}  # the parameter that names the estimator


@dataclass
class DataSetFacts:
    """Facts from the headers and a few datasets of all files of a folder."""

    formats: dict[str, set[str]] = field(default_factory=dict)  # kind -> numbers of its format
    versions: set[str] = field(default_factory=set)  # of evetac
    year: str | None = None  # of the newest file
    how: dict[str, Counter[str]] = field(default_factory=dict)  # kind -> estimator -> number of files
    abstained: int = 0  # labels that could not identify an onset
    with_losses: int = 0  # recordings with lost slices

    def add(self, file: StageFile) -> None:
        """Add the facts of a file."""
        header, creation = file.header, file.header.get("made", {})
        self.formats.setdefault(file.kind, set()).add(str(header["version"]))
        if isinstance(creation.get("evetac"), str):
            self.versions.add(creation["evetac"][:20])
        year = str(creation.get("at", ""))[:4]
        if year.isdigit():
            self.year = max(self.year or year, year)
        if file.kind in ESTIMATED:
            how = str(header["parameters"].get(HOW.get(file.kind, ""), "unknown"))[:40]
            self.how.setdefault(file.kind, Counter())[how] += 1
        self.abstained += file.kind == "labels" and file.has("abstained") and int(file.read("abstained"))
        self.with_losses += file.has("capture/lost_slices") and file.length("capture/lost_slices") > 0


def look(folder: Path, rows: Sequence[IndexRow], progress: Progress) -> DataSetFacts:
    """Open all files of a folder and return their facts."""
    contents = DataSetFacts()
    for number, row in enumerate(rows):
        progress(number, len(rows), "files")
        with StageFile(folder / row.path) as file:
            contents.add(file)
    return contents


def limitations(contents: DataSetFacts, trials: Sequence[IndexRow], split: Sequence[tuple[str, IndexRow]]) -> list[str]:
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


COVERED: Mapping[str, str] = {"sensor": "sensor", "object": "object", "scene": "scene"}


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
        f"{len(values)} {COVERED[what]}{'' if len(values) == 1 else 's'}" if values else f"no known {COVERED[what]}"
        for what, values in covered.items()
    ]
    one = [COVERED[what] for what, values in covered.items() if len(values) == 1]
    alone = f" The data cannot show how well a method generalizes to another {' or '.join(one)}." if one else ""
    return f"{trials} trial{'' if trials == 1 else 's'}: {', '.join(parts)}.{alone}"
