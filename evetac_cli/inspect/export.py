"""export: write recordings, and the data computed from them, in formats that other programs read."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
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
from evetac_cli.store.hdf5.disk import check_free
from evetac_cli.text_files import as_utf8

OF_TRACKS = ("features", "touch")  # kinds of files that are computed from tracks


def run(
    files: list[Path], params: Export, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write a file for every recording, or one folder; all or none, so that an interrupted command can be repeated.

    Raises InputError, before any file is written, if two recordings would have the same output, or if an output exists.
    """
    options = _options(params)
    opened: Opener = partial(trial_files, model=_model(params))
    if is_folder(params.format, out):
        if out is None:
            raise InputError(
                f"the format {params.format} needs a folder for its files",
                where="--out",
                expected="a folder",
                found="none",
            )
        row = export_folder(files, params.format, out, options, progress=progress, opened=opened)
        return Outcome([row], bool(row.pop("simulated")), {"files": len(files)})
    targets = [target_path(file, params.format, out) for file in files]
    twice = sorted({str(target) for target in targets if targets.count(target) > 1})
    if twice:
        raise InputError("several recordings would be written to the same file", found=", ".join(twice))
    for target in targets:
        check_free(target, force=force)
    with ExitStack() as together:
        alike = partial(export, options=options, force=force, progress=progress, opened=opened, together=together)
        rows = [alike(file, params.format, target) for file, target in zip(files, targets, strict=True)]
    simulated = any([row.pop("simulated") for row in rows])
    return Outcome(rows, simulated, {"files": len(rows)})


def _model(params: Export) -> Path | None:
    """Return the model whose slip probability is requested; raise InputError if it is not a model, before any work."""
    if params.model is None:
        return None
    path = model_file(params.model)
    StageFile(path, "model").close()
    return path


def _options(params: Export) -> dict[str, Any]:
    """Return the chosen options for the format's writer; raise InputError for options that the format does not use."""
    values = {item.name: getattr(params, item.name) for item in fields(Export) if item.name != "format"}
    options = {name: value for name, value in values.items() if value is not None}
    takes = named_format(params.format).takes
    for name in options:
        if name not in takes:
            others = ", ".join(other for other, row in FORMATS.items() if name in row.takes)
            flag = flag_of(Export.__dataclass_fields__[name])
            raise InputError(
                "has no effect with this format",
                where=flag,
                expected=f"--format {others}",
                found=params.format,
            )
    if "task" in options:
        options["task"] = as_utf8(options["task"])
    if "test_objects" in options:
        options["test_objects"] = numbers(options["test_objects"])
    if "size" in options:
        options["size"] = _size(options["size"])
    options.pop("model", None)
    return options


def _size(text: str) -> tuple[int, int]:
    """Parse width and height from text such as `160x120`; raise InputError if it is invalid."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and max(len(width), len(height)) < 6 and int(width) * int(height)):
        raise InputError("not a valid size", where="--size", expected="WIDTHxHEIGHT in px, e.g. 160x120", found=text)
    return int(width), int(height)


@contextmanager
def trial_files(path: Path, model: Path | None = None) -> Iterator[TrialFiles]:
    """Open the files of a recording's trial, found next to it as in `view`; features of other tracks are left out.

    With a model, its slip probability is included. Raises InputError if its features can neither be found nor computed,
    or if the model is for another dot grid.
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
        if trial.model_input is None or (trial.features is not None and "features" not in by_kind):
            expected = "features next to the recording, made from the tracks there, or none"
            raise InputError(
                "the model needs features of this recording", where=str(path), expected=expected, found=" ".join(notes)
            )
        probability = model_output(trial, (0, trial.slices))
        yield TrialFiles(by_kind, notes, probability)
