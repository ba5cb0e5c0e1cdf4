"""export: write recordings, and what was computed from them, in formats that other programs read."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.commands.export import Export
from evetac_cli.commands.parameter import flag_of
from evetac_cli.errors import InputError
from evetac_cli.formats.exports import FORMATS, export, export_folder, is_folder, target_path
from evetac_cli.formats.write.slice_columns import Opener, TrialFiles
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.pages.view.time_series import model_output
from evetac_cli.pages.view.trial_files import open_trial
from evetac_cli.resources import model_file
from evetac_cli.sim.setup.plan import numbers
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import as_utf8

OF_TRACKS = ("features", "touch")  # kinds that are made from tracks
LEROBOT = ("fps", "per_frame", "test_objects", "task", "tactile_key")  # parameters of this format alone


def run(
    files: list[Path], params: Export, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write a file for every recording, or one folder of all; InputError, before any is written, for equal names."""
    options = _options(params)
    opened: Opener = partial(trial_files, model=_model(params))
    if is_folder(params.format, out):
        if out is None:
            raise InputError(
                f"{params.format} is a folder of many files", where="--out", expected="a folder", found="none"
            )
        row = export_folder(files, params.format, out, options, force=force, progress=progress, opened=opened)
        return Outcome([row], bool(row.pop("simulated")), {"files": len(files)})
    targets = [target_path(file, params.format, out) for file in files]
    twice = sorted({str(target) for target in targets if targets.count(target) > 1})
    if twice:
        raise InputError("several recordings would write the same output", found=", ".join(twice))
    rows = [
        export(file, params.format, target, force=force, progress=progress, opened=opened)
        for file, target in zip(files, targets, strict=True)
    ]
    simulated = any([row.pop("simulated") for row in rows])
    return Outcome(rows, simulated, {"files": len(rows)})


def _model(params: Export) -> Path | None:
    """The model whose slip probability is wanted; InputError if it is none, before any work."""
    if params.model is None:
        return None
    path = model_file(params.model)
    StageFile(path, "model").close()
    return path


def _options(params: Export) -> dict[str, Any]:
    """What was chosen for the format; InputError for what has no effect with it."""
    tables = [name for name, row in FORMATS.items() if row.of_trial and not row.events]
    if params.model is not None and params.format not in tables:
        expected = f"--format {', '.join(tables)}"
        raise InputError("has no effect", where="--model", expected=expected, found=params.format)
    given = {name: getattr(params, name) for name in LEROBOT if getattr(params, name) is not None}
    if params.format != "lerobot" and given:
        named = [flag_of(item) for name, item in Export.__dataclass_fields__.items() if name in given]
        raise InputError("has no effect", where=", ".join(named), expected="--format lerobot", found=params.format)
    if "task" in given:
        given["task"] = as_utf8(given["task"])
    if "test_objects" in given:
        given["test_objects"] = numbers(given["test_objects"])
    return given


@contextmanager
def trial_files(path: Path, model: Path | None = None) -> Iterator[TrialFiles]:
    """The files of a recording's trial, as `view` finds them beside it; features of other tracks are left out.

    With a model also its slip probability; InputError if there are no features, or it is for another dot grid.
    """
    with open_trial([path] if model is None else [path, model]) as trial:
        if trial.recording is None:
            raise InputError("wrong kind of file", where=str(path), expected="recording", found=trial.files[0].kind)
        by_kind = {file.kind: file for file in trial.files}
        notes = list(trial.notes)
        if trial.tracks is not None:
            made_from = {kind: file.header["parents"] for kind, file in by_kind.items() if kind in OF_TRACKS}
            others = [kind for kind, parents in made_from.items() if trial.tracks.header["id"] not in parents]
            notes += [f"Left out: {by_kind.pop(kind).path.name} was made from other tracks." for kind in others]
        if model is None:
            yield TrialFiles(by_kind, notes)
            return
        if "features" not in by_kind:
            hint = "evetac track, then evetac featurize"
            raise InputError("a model needs features", where=str(path), expected="features beside it", hint=hint)
        probability = model_output(trial, (0, trial.slices))
        yield TrialFiles(by_kind, notes, probability)
