"""Missing parts of a study that its files would allow, each with the command that creates it.

Only suitable commands are offered: no grasp evaluation for a folder of slips, no slip labels if the gel has no window.
"""

import shlex
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.pages.report.evaluations import SECTIONS
from evetac_cli.pages.report.study import Study, StudyTrial
from evetac_cli.resources import MODEL, SHIPPED
from evetac_cli.stages.splits import recording_ids
from evetac_cli.store.files import StageFile

MOST_PATHS = 20  # per command
MOST_MODELS = 20  # whose training recordings are read
STAGES = (("tracks", "track"), ("labels", "label"), ("features", "featurize"))  # in processing order


class Lack(NamedTuple):
    """A missing part in words, and the command that creates it; no command if there is none."""

    says: str
    command: str = ""


def missing(study: Study) -> list[Lack]:
    """Return the missing parts of a study; commands are for a shell in the folder where the report was made."""
    lacks = []
    if not study.files["recording"]:
        lacks.append(Lack("There are no recordings, so there are no events, truth or thumbnails."))
    for kind, command in STAGES:
        without = [trial for trial in study.trials if kind not in trial.files and _allows(kind, trial)]
        if without:
            says = f"{len(without)} of {len(study.trials)} trials {'has' if len(without) == 1 else 'have'} no {kind}."
            lacks.append(Lack(says, command_for(command, _with_their_folders(study, without, kind))))
    if study.files["labels"] and not any(trial.has_truth for trial in study.trials):
        lacks.append(Lack("No recording has ground truth, so labels cannot be evaluated."))
    for section in SECTIONS:
        if section.name in _OFFERS and not study.reports(f"evaluate {section.name}"):
            lacks += [lack._replace(says=f"{section.title}{lack.says}") for lack in _OFFERS[section.name](study)]
    return lacks


def _allows(kind: str, trial: StudyTrial) -> bool:
    """Whether a stage can make a kind of file from a trial: tracking needs a dot grid, slip labels need the window."""
    if "recording" not in trial.files or trial.broken or trial.grasp is not None:
        return False
    return trial.has_dots and (kind == "tracks" or trial.has_window)


def _with_their_folders(study: Study, trials: list[StudyTrial], kind: str) -> list[Path]:
    """Return the folders of these trials; where a folder has unsuitable recordings too, the recordings instead."""
    recordings = [trial for trial in study.trials if "recording" in trial.files]
    refused = {_folder(study, trial, "recording") for trial in recordings if not _allows(kind, trial)}
    paths = ((_folder(study, trial, "recording"), study.folder / trial.files["recording"]) for trial in trials)
    return list(dict.fromkeys(path if folder in refused else folder for folder, path in paths))


# Evaluations ----------------------------------------------------------------------------------------------------------


def _offer(command: str, kind: str, suits: Callable[[StudyTrial], bool], *more: str) -> Callable[[Study], list[Lack]]:
    """Return a function that offers an evaluation of a kind of file in folders where all such trials suit."""

    def offer(study: Study) -> list[Lack]:
        having = [trial for trial in study.trials if kind in trial.files]
        refused = {_folder(study, trial, kind) for trial in having if not suits(trial)}
        folders = [folder for folder in _folders(study, having, kind) if folder not in refused]
        return [Lack(".", command_for(f"evaluate {command}", folders, *more))] if folders else []

    return offer


def _slip(study: Study) -> list[Lack]:
    """Offer slip detection by models that were not trained on these trials: the folder's, else the pretrained one."""
    offered = _offer("slip", "features", lambda trial: "labels" in trial.files)(study)
    if not offered:
        return []
    here = {trial.recording_id for trial in study.trials if "features" in trial.files}
    new = [path for path in study.models_at[:MOST_MODELS] if _is_new(path, here)]
    models = [_word(path) for path in new] or ([SHIPPED] if _is_new(MODEL, here) else [])
    if not models:
        return [Lack(": every model here may have been trained on these trials; train a model on other trials.")]
    return [lack._replace(command=" ".join((lack.command, "--model", *models))) for lack in offered]


def _is_new(model: Path, recordings: set[str]) -> bool:
    try:
        return not trained_on(model) & recordings
    except InputError:
        return False


def trained_on(model: Path) -> set[str]:
    """Return the ids of the recordings that a model was trained on; raise InputError if it cannot be read."""
    with StageFile(model, "model") as file:
        return recording_ids(file.header)


def _realism(study: Study) -> list[Lack]:
    """Offer to compare a real recording with a simulated one of the same frame, if the folder has both."""
    first: dict[tuple[int, int], dict[bool, Path]] = {}
    for trial in study.trials:
        if trial.frame_px is not None:
            of_frame = first.setdefault(trial.frame_px, {})
            of_frame.setdefault(bool(trial.row.simulated), study.folder / trial.files["recording"])
    both = next((of_frame for of_frame in first.values() if len(of_frame) == 2), None)
    return [] if both is None else [Lack(".", command_for("evaluate realism", (both[False], both[True])))]


_OFFERS: dict[str, Callable[[Study], list[Lack]]] = {
    "slip": _slip,
    "labels": _offer("labels", "labels", lambda trial: trial.has_truth),
    "tracking": _offer("tracking", "tracks", lambda trial: "recording" in trial.files),
    "grasp": _offer("grasp", "recording", lambda trial: trial.grasp is not None),
    "force": _offer("force", "touch", lambda trial: trial.has_truth and "tracks" in trial.files),
    "vibration": _offer("vibration", "recording", lambda trial: (trial.row.scene or "").startswith("vibration")),
    "data-rate": _offer(
        "data-rate", "recording", lambda trial: trial.row.scene == "data-rate" or not trial.row.simulated
    ),
    "realism": _realism,
}


# Words of a shell -----------------------------------------------------------------------------------------------------


def _folder(study: Study, trial: StudyTrial, kind: str) -> Path:
    return (study.folder / trial.files[kind]).parent


def _folders(study: Study, trials: Iterable[StudyTrial], kind: str) -> list[Path]:
    """Return the folders of files of a kind: commands search the given folders, but not their subfolders."""
    return list(dict.fromkeys(_folder(study, trial, kind) for trial in trials))


def command_for(command: str, paths: Iterable[Path], *more: str) -> str:
    """Return a command of evetac for a shell, with at most MOST_PATHS of the paths."""
    return " ".join(("evetac", command, *[_word(path) for path in paths][:MOST_PATHS], *more))


def _word(path: Path) -> str:
    """Return a path as one shell word that no command mistakes for a flag."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)
