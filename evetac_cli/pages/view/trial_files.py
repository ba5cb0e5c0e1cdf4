"""The files of one trial for view: the given ones, and those next to them of the same recording."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.errors import MAKE_MODEL, InputError, UnavailableError, made_by
from evetac_cli.jobs import Job, Progress, silent
from evetac_cli.kernels.slip.architectures import ImageArchitecture, MemoryArchitecture, PluginImageArchitecture
from evetac_cli.pages.shared import inner
from evetac_cli.stages import featurize, track
from evetac_cli.stages.model_files import why_useless
from evetac_cli.store.files import StageFile, stem
from evetac_cli.store.layout.ancestry import recording_of
from evetac_cli.store.layout.rules import named_architecture
from evetac_cli.store.recordings.read import Recording

KINDS = ("recording", "tracks", "labels", "features", "touch")


@dataclass
class OpenTrial:
    """A recording and the files made from it, all open; missing ones are None, and notes state what was left out."""

    recording_id: str
    recording: Recording | None = None
    tracks: StageFile | None = None
    labels: StageFile | None = None
    features: StageFile | None = None
    touch: StageFile | None = None
    model: StageFile | None = None
    model_input: StageFile | None = None  # the features, or those computed for the page
    notes: list[str] = field(default_factory=list)

    @property
    def files(self) -> list[StageFile]:
        """The files that exist."""
        files = (self.recording, self.tracks, self.labels, self.features, self.touch, self.model)
        return [file for file in files if file is not None]

    @property
    def slices(self) -> int:
        """Length of the trial in ms: that of the recording, else of the files made from it."""
        if self.recording is not None:
            return len(self.recording)
        rows = (
            (self.tracks, "dot_xy_px"),
            (self.labels, "label"),
            (self.features, "events_total"),
            (self.touch, "known"),
        )
        return max((file.length(path) for file, path in rows if file is not None), default=0)

    @property
    def recording_parameters(self) -> Any:
        """The parameters of the recording, which every file of a trial has in its history."""
        if self.recording is not None:
            return self.recording.header["parameters"]
        return inner(self.files[0].header["history"], self.recording_id, "parameters")

    def add(self, file: StageFile) -> None:
        """Add a file under its kind."""
        setattr(self, file.kind, file)


@contextmanager
def open_trial(paths: list[Path], progress: Progress = silent) -> Iterator[OpenTrial]:
    """Open the given files and those next to them; raise InputError if the given files are not of one trial.

    Features for a given model are computed from the recording if there are none.

    A file next to them that is damaged or of another recording is left out, with a note.
    """
    with ExitStack() as stack:
        files = [stack.enter_context(_open(path)) for path in dict.fromkeys(paths)]
        trial = OpenTrial(_one_recording(files))
        for file in files:
            if getattr(trial, file.kind) is not None:
                raise InputError(
                    f"two {file.kind} files",
                    where=str(file.path),
                    expected="files of one trial",
                    found=str(getattr(trial, file.kind).path),
                )
            trial.add(file)
        for path in _beside(files):
            if getattr(trial, _kind_of(path)) is not None:
                continue
            try:
                file = stack.enter_context(_open(path))
            except (InputError, UnavailableError) as error:
                trial.notes.append(f"Left out: {str(error).splitlines()[0].removeprefix(f'{path.parent}/')}")
                continue
            if file.kind == _kind_of(path) and _recording_id(file) == trial.recording_id:
                trial.add(file)
            else:
                trial.notes.append(f"Left out: {path.name} was made from another recording.")
        if trial.recording is None:
            trial.notes.append(f"The recording {trial.recording_id[:12]} is not next to these files: no event images.")
        _find_model_input(trial, stack, progress)
        _check_model(trial)
        yield trial


def _open(path: Path) -> StageFile:
    """Open a file after checking its contents, before deciding which files are shown."""
    with ExitStack() as stack:
        file = stack.enter_context(StageFile(path, (*KINDS, "model")))
        file.check()
        if file.kind != "recording":
            stack.pop_all()
            return file
    return Recording(path)


def _kind_of(path: Path) -> str:
    return path.name.split(".")[-2]


def _recording_id(file: StageFile) -> str | None:
    """Return the id of the recording itself, or of the one from which a file, or its tracks, was made."""
    if file.kind == "recording":
        return str(file.header["id"])
    made_from = recording_of(file.header, file.header["history"])
    return str(made_from["id"]) if made_from else None


def _one_recording(files: list[StageFile]) -> str:
    """Return the recording to which all given files belong (a model belongs to any)."""
    of_trial = [file for file in files if file.kind != "model"]
    if not of_trial:
        raise InputError(
            "a model alone has nothing to show",
            where=str(files[0].path),
            expected=", ".join(KINDS),
            hint=f"give features too ({made_by('features')}): the page then shows the model's slip probability on them",
        )
    first = _recording_id(of_trial[0])
    for file in of_trial:
        if _recording_id(file) != first:
            raise InputError(
                "these files are from two trials",
                where=str(file.path),
                expected=f"like {of_trial[0].path.name}, made from recording {(first or 'unknown')[:12]}",
                found=f"recording {(_recording_id(file) or 'unknown')[:12]}",
                hint="a page shows one trial: run evetac view once per trial",
            )
    if first is None:
        raise InputError("the file's header names no recording", where=str(of_trial[0].path))
    return first


def _find_model_input(trial: OpenTrial, stack: ExitStack, progress: Progress) -> None:
    """Set the features for the model; a note says that they were computed, or why that failed.

    They are computed if there are none, or if those that exist lack the sticking share that the model needs.
    """
    trial.model_input = trial.features
    if trial.model is None:
        return
    needed = _needed_features(trial.model)
    if trial.features is not None and (trial.features.has("slip_begun") or not needed.sticking_share):
        return
    trial.model_input = None
    if trial.recording is None:
        trial.notes.append("No slip probability: it needs the recording or its features.")
        return
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="evetac-view-")))
    path = trial.recording.path
    tracks, features = (folder / f"{stem(path)}.{kind}.h5" for kind in ("tracks", "features"))
    try:
        if trial.tracks is None:
            track.run(Job((path,), tracks), Track(), progress=progress)
        else:
            tracks = trial.tracks.path
        featurize.run(Job((path, tracks), features), needed, progress=progress)
    except (InputError, UnavailableError) as error:
        trial.notes.append(f"No slip probability: {str(error).splitlines()[0]}")
        return
    trial.model_input = stack.enter_context(StageFile(features, "features"))
    by = "evetac featurize" if trial.tracks is not None else "evetac track and evetac featurize"
    trial.notes.append(f"The features for {trial.model.path.name} were computed as by {by}, and are not stored.")


def _needed_features(model: StageFile) -> Featurize:
    """Return the flags of `featurize` that make the inputs of a model."""
    architecture = named_architecture(model.read("architecture"))
    images, events = (isinstance(architecture, one) for one in (ImageArchitecture, PluginImageArchitecture))
    return Featurize(images=images, events=events, sticking_share=isinstance(architecture, MemoryArchitecture))


def _check_model(trial: OpenTrial) -> None:
    if trial.model is not None and (why := why_useless(trial.model)):
        trial.notes.append(f"{trial.model.path.name} is not a slip detector: {why}.")
    if trial.model is None or trial.model_input is None:
        return
    of_features, of_model = (file.read("dot_shape").tolist() for file in (trial.model_input, trial.model))
    if of_features != of_model:
        raise InputError(
            "the model is for another dot grid",
            where=str(trial.model.path),
            expected=str(of_features),
            found=str(of_model),
            hint=MAKE_MODEL,
        )


def _beside(files: list[StageFile]) -> list[Path]:
    """Return files of the same name and another kind next to the given ones."""
    paths = [
        file.path.with_name(f"{stem(file.path)}.{kind}.h5") for file in files if file.kind != "model" for kind in KINDS
    ]
    return [path for path in dict.fromkeys(paths) if path.is_file()]
