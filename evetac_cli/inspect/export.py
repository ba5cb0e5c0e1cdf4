"""export: write recordings, and what was computed from them, in formats that other programs read."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.commands.export import Export
from evetac_cli.commands.parameter import flag_of
from evetac_cli.errors import InputError
from evetac_cli.formats.exports import FORMATS, export, export_folder, is_folder, named_format, target_path
from evetac_cli.formats.write.slice_columns import Opener, TrialFiles
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.pages.view.time_series import model_output
from evetac_cli.pages.view.trial_files import open_trial
from evetac_cli.resources import model_file
from evetac_cli.sim.setup.plan import numbers
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import as_utf8

OF_TRACKS = ("features", "touch")  # kinds that are made from tracks


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
        export(file, params.format, target, options, force=force, progress=progress, opened=opened)
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
    """What was chosen for the format, for its writer; InputError for what has no effect with it."""
    chosen = {item.name: getattr(params, item.name) for item in fields(Export) if item.name != "format"}
    given = {name: value for name, value in chosen.items() if value is not None and value is not False}
    takes = named_format(params.format).takes
    for name in given:
        if name not in takes:
            others = ", ".join(other for other, row in FORMATS.items() if name in row.takes)
            flag = flag_of(Export.__dataclass_fields__[name])
            raise InputError("has no effect", where=flag, expected=f"--format {others}", found=params.format)
    if "task" in given:
        given["task"] = as_utf8(given["task"])
    if "test_objects" in given:
        given["test_objects"] = numbers(given["test_objects"])
    if "size" in given:
        given["size"] = _size(given["size"])
    given.pop("model", None)
    return given


def _size(text: str) -> tuple[int, int]:
    """Width and height from `160x120`; InputError."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and max(len(width), len(height)) < 6):
        raise InputError("no size", where="--size", expected="width and height in px, as in 160x120", found=text)
    if 0 in (int(width), int(height)):
        raise InputError("no size", where="--size", expected="a width and a height of 1 px or more", found=text)
    return int(width), int(height)


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
        scale = partial(_mm_per_px, by_kind["touch"]) if "touch" in by_kind else None
        if model is None:
            yield TrialFiles(by_kind, notes, mm_per_px=scale)
            return
        if "features" not in by_kind:
            hint = "evetac track, then evetac featurize"
            raise InputError("a model needs features", where=str(path), expected="features beside it", hint=hint)
        probability = model_output(trial, (0, trial.slices))
        yield TrialFiles(by_kind, notes, probability, scale)


def _mm_per_px(touch: StageFile) -> float:
    """The scale of the maps of a touch file; asked for late, since the stage that knows it loads compiled code."""
    from evetac_cli.stages.touch.known_gel import mm_per_px_of

    return mm_per_px_of(touch.header)
