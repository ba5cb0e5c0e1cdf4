"""Contents of a folder: its trials with their onsets as far as known, and the reports of `evaluate` in it."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError, UnavailableError
from evetac_cli.evaluate.common.marks import LABELS, Source
from evetac_cli.evaluate.labels.measure import EARLIEST_MS, LATEST_MS
from evetac_cli.events import SLICE_US
from evetac_cli.jobs import Progress, Rows
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.kernels.slip import metrics
from evetac_cli.pages.shared import LARGEST_BYTES
from evetac_cli.pages.view.event_images import picture
from evetac_cli.stages.related_files import UNKNOWN_SENSOR, RecordedSensor, sensor_names, sensor_of
from evetac_cli.store.data_set import FileRow, foreign_note, read_data_set
from evetac_cli.store.files import StageFile, stem
from evetac_cli.store.layout.ancestry import recording_of
from evetac_cli.store.recordings.onset import labelled_onset
from evetac_cli.store.recordings.read import Recording, open_recording, true_onset
from evetac_cli.text_files import open_regular, read_bytes

TIMING_MS = (metrics.EARLIEST_MS, metrics.LATEST_MS)  # of a correct first detection
LABELS_MS = (EARLIEST_MS, LATEST_MS)
OF_TRIAL = ("recording", "labels", "tracks", "features", "touch")
SHOWN_MS = 5  # duration of events in a thumbnail
THUMBNAIL_PX = 160
THUMBNAIL_BYTES = 8_000_000  # of PNG per page; a third more as base64
VIEW_MARK = b"- evetac view</title>"


@dataclass
class Found:
    """A report of `evaluate` found in the folder."""

    path: str  # relative to the folder
    command: str
    header: dict[str, Any]
    rows: Rows
    summary: dict[str, Any]
    plot: bytes | None = None  # PNG drawn by `evaluate`, if it is in the folder of the report

    @property
    def simulated(self) -> bool:
        """Whether any of it comes from a simulation."""
        return bool(self.header["simulated"])

    @cached_property
    def source(self) -> Source:
        """The origin of its rows."""
        return Source.of([self.header])

    def recordings(self, kind: str) -> list[str | None]:
        """Return the ids of the recordings behind its input files of a kind, in the order of its rows."""
        history = self.header["history"]
        parents = [history[parent] for parent in self.header["parents"] if parent in history]
        made_from = [recording_of(parent, history) for parent in parents if parent["kind"] == kind]
        return [None if recording is None else recording["id"] for recording in made_from]


@dataclass
class StudyTrial:
    """One trial of a data set, with results from its files and the reports; None for missing ones."""

    recording_id: str
    row: FileRow  # of its recording, else of another of its files
    files: dict[str, str]  # kind -> path relative to the folder
    events: int | None = None
    has_truth: bool = False
    sensor: RecordedSensor = UNKNOWN_SENSOR
    t_s: int | None = None  # ms; truth
    t_c: int | None = None  # ms; labels; None if they abstain
    doubt: str = ""  # why the labels abstain
    labelled_by: str | None = None
    late_by: list[int | None] = field(default_factory=list)  # t_m - t_c in ms for each model; None: never detected
    late_by_truth: list[int | None] = field(default_factory=list)  # the same for t_m - t_s
    not_timed: int = 0  # models without t_m - t_c, as the labels abstain or have no onset
    tracking_px: float | None = None
    grasp: dict[str, Any] | None = None
    thumbnail: bytes | None = None
    page: Path | None = None  # written by `view`
    broken: str = ""  # why its recording cannot be read

    @property
    def name(self) -> str:
        """Its name, including its folder."""
        path = Path(self.row.path)
        return str(path.with_name(stem(path)))

    @property
    def label_error_ms(self) -> int | None:
        """t_c - t_s."""
        return None if self.t_c is None or self.t_s is None else self.t_c - self.t_s

    @property
    def model_error_ms(self) -> float | None:
        """t_m - t_c, median over the models; infinite if most of them never detect the slip."""
        return _median(self.late_by)

    @property
    def model_truth_error_ms(self) -> float | None:
        """t_m - t_s, like `model_error_ms`."""
        return _median(self.late_by_truth)


def _median(late_by: list[int | None]) -> float | None:
    if not late_by:
        return None
    return float(np.quantile([np.inf if ms is None else ms for ms in late_by], 0.5, method="higher"))


@dataclass
class Study:
    """A folder: trials, reports, and its other files."""

    folder: Path
    name: str
    trials: list[StudyTrial]
    evaluations: list[Found]
    files: Counter[str]  # by kind
    unreadable: list[tuple[str, str]]  # path, reason
    simulated: bool
    notes: list[str]

    def reports(self, command: str) -> list[Found]:
        """Return the reports of an evaluation."""
        return [one for one in self.evaluations if one.command == command]

    @property
    def models(self) -> int:
        """The largest number of models evaluated on one trial."""
        return max((len(trial.late_by) for trial in self.trials), default=0)


def read_study(folder: Path, progress: Progress) -> Study:
    """Search a folder; raise InputError if it contains no file of evetac."""
    if next(folder.rglob("*.h5"), None) is None:
        others = sum(1 for path in folder.iterdir() if not path.name.startswith("."))
        raise _nothing(folder, f"{others} other files and folders" if others else "an empty folder")
    rows = read_data_set(folder, progress)
    passed_over = foreign_note(rows)
    files = Counter(row.kind for row in rows if row.kind is not None)
    unreadable = [(row.path, row.error) for row in rows if row.error is not None]
    if not files:
        raise _nothing(folder, "; ".join([*(f"{path}: {reason}" for path, reason in unreadable[:3]), passed_over]))
    study = Study(
        folder, folder.resolve().name or str(folder), [], [], files, unreadable, any(row.simulated for row in rows), []
    )
    if passed_over:
        study.notes.append(f"{passed_over[0].upper()}{passed_over[1:]}.")
    for row in rows:
        if row.kind == "report":
            _read_report(study, row.path)
    groups: dict[str, dict[str, FileRow]] = {}
    several: Counter[str] = Counter()
    for row in rows:
        if row.recording is None or row.kind is None or row.kind not in OF_TRIAL:
            continue
        group = groups.setdefault(row.recording, {})
        several[row.kind] += row.kind in group
        group.setdefault(row.kind, row)
    for kind, count in several.items():
        if count:
            study.notes.append(f"{count} trials have several {kind} files: the first by name are shown.")
    room = THUMBNAIL_BYTES
    for number, (id_, group) in enumerate(groups.items()):
        progress(number, len(groups))
        first = next(group[kind] for kind in OF_TRIAL if kind in group)
        outcome = next((row.outcome for row in group.values() if row.outcome is not None), None)
        first = first._replace(outcome=outcome)  # a real recording's outcome is stored with its labels
        trial = StudyTrial(id_, first, {kind: row.path for kind, row in group.items()})
        _read_trial(folder, trial, draw=room > 0)
        room -= len(trial.thumbnail or b"")
        study.trials.append(trial)
    if room <= 0:
        study.notes.append("Thumbnails: only of the first trials, to keep the page small.")
    _judge(study)
    return study


def name_sensors(studies: Sequence[Study]) -> None:
    """Name the sensors of all trials as `evaluate slip --by sensor` does: different ones never have the same name."""
    trials = [trial for study in studies for trial in study.trials if trial.sensor != UNKNOWN_SENSOR]
    for trial, name in zip(trials, sensor_names([trial.sensor for trial in trials]), strict=True):
        trial.row = trial.row._replace(sensor=name)


def _nothing(folder: Path, holds: str) -> InputError:
    return InputError(
        "no evetac files in this folder",
        where=str(folder),
        expected="stage files such as a.recording.h5, in the folder or its subfolders",
        found=holds,
        hint=f"evetac record --out {folder} creates some",
    )


def _read_report(study: Study, path: str) -> None:
    """Add a report to the study, and the plot beside it."""
    try:
        with StageFile(study.folder / path, "report") as file:
            command = str(file.read("command"))
            texts = [json.loads(file.read(name)) for name in ("rows", "summary")]
            found = Found(path, command, file.header, *texts)
        study.evaluations.append(found)
        path = str(Path(path).with_suffix(".png"))
        if (study.folder / path).exists():
            found.plot = read_bytes(study.folder / path, LARGEST_BYTES)
    except (InputError, UnavailableError) as error:
        study.unreadable.append((path, error.message))


def _read_trial(folder: Path, trial: StudyTrial, *, draw: bool) -> None:
    """Read onsets, events and a thumbnail of one trial; on an error, store its message and leave the rest out."""
    page = (folder / trial.row.path).with_name(f"{stem(Path(trial.row.path))}.html")
    trial.page = page if _is_view(page) else None
    try:
        if "labels" in trial.files:
            with StageFile(folder / trial.files["labels"], "labels") as labels:
                onset = labelled_onset(labels)
                trial.doubt = onset.doubt
                trial.t_c = None if onset.abstained else onset.slice_
                trial.labelled_by = str(labels.header["parameters"].get("method", "farneback"))
        if "recording" in trial.files:
            with open_recording(folder / trial.files["recording"]) as recording:
                trial.sensor = sensor_of(recording.header)
                trial.events = recording.event_count
                if recording.has("control/outcome"):
                    trial.grasp = json.loads(recording.read("control/outcome"))
                trial.has_truth = recording.has("truth/slip")
                trial.t_s = true_onset(recording) if trial.has_truth else None
                if draw and len(recording):
                    trial.thumbnail = _thumbnail(trial, recording)
        else:
            with StageFile(folder / trial.row.path) as file:
                trial.sensor = sensor_of(file.header)
    except (InputError, UnavailableError) as error:
        trial.broken = error.message


def _is_view(path: Path) -> bool:
    """Whether a file is a page of `view`."""
    try:
        with open_regular(path) as file:
            return VIEW_MARK in file.read(2000)
    except (InputError, UnavailableError):
        return False


def _thumbnail(trial: StudyTrial, recording: Recording) -> bytes:
    """Return the event image at the onset by truth, labels or the grasp's detector; else the image with most events."""
    for at in (trial.t_s, trial.t_c, *_detected_while_grasping(recording)):
        if at is not None and at < len(recording):
            image, events = picture(recording, at, SHOWN_MS, THUMBNAIL_PX)
            if events:
                return image
    starts = recording.starts
    width = min(SHOWN_MS, len(recording))
    busiest = int(np.argmax(starts[width:] - starts[:-width]))
    return picture(recording, busiest, SHOWN_MS, THUMBNAIL_PX)[0]


def _detected_while_grasping(recording: Recording) -> Iterator[int]:
    """Yield the first slice, if any, in which a grasp's detector reported slip after the light contact."""
    if recording.has("control"):
        slip = (recording.read("control/slip") > 0) & (recording.read("control/phase") > GraspPhase.CONTACT)
        yield from (int(recording.read("control/t_us")[at] // SLICE_US) for at in np.flatnonzero(slip)[:1])


def by_truth(report: Found) -> bool:
    """Whether a report of `evaluate slip` judged trials by the simulation's truth instead of labels."""
    return bool(report.summary.get("judged_by", LABELS) != LABELS)


def _judge(study: Study) -> None:
    """Add the reports' results to the trials: detections of every model, distance of the dots from truth."""
    trials = {trial.recording_id: trial for trial in study.trials}
    late_by: dict[bool, dict[str, dict[tuple[str, str], int | None]]] = {False: {}, True: {}}  # by truth or not
    not_timed: dict[str, set[tuple[str, str]]] = {}
    for report in study.reports("evaluate slip"):
        rows = [row for row in report.rows if "t_m_minus_t_c_ms" in row and "t_c_ms" in row]
        recordings = report.recordings("features")
        for row, id_ in zip(rows, recordings * (len(rows) // max(len(recordings), 1)), strict=False):
            if id_ not in trials:
                continue
            model = (str(row["setting"]), str(row["model_file"]))
            if row["t_c_ms"] is not None:
                late_by[by_truth(report)].setdefault(id_, {})[model] = row["t_m_minus_t_c_ms"]
            elif not by_truth(report):
                not_timed.setdefault(id_, set()).add(model)
    for id_, trial in trials.items():
        trial.late_by = list(late_by[False].get(id_, {}).values())
        trial.late_by_truth = list(late_by[True].get(id_, {}).values())
        trial.not_timed = len(not_timed.get(id_, set()) - late_by[False].get(id_, {}).keys())
    for report in study.reports("evaluate tracking"):
        rows = [row for row in report.rows if "file" in row]
        for row, id_ in zip(rows, report.recordings("tracks"), strict=False):
            if id_ in trials:
                trials[id_].tracking_px = row["error_px_rms"]


# Outliers -------------------------------------------------------------------------------------------------------------

LOST, NEVER = 1e6, 1e5  # higher than any error in ms


def remark(trial: StudyTrial) -> tuple[float, str]:
    """Return an outlier's score, 0 for other trials, and the reasons."""
    reasons: list[tuple[float, str]] = []
    if trial.broken:
        reasons.append((10 * LOST, trial.broken))
    if trial.grasp is not None and not trial.grasp.get("balanced"):
        reasons.append((LOST, "lost in balance" if trial.grasp.get("lifted") else "not lifted"))
    if trial.events == 0:
        reasons.append((LOST, "no events"))
    if trial.t_s is not None and trial.labelled_by is not None and trial.t_c is None and not trial.doubt:
        reasons.append((NEVER, "slips, but the labels have no onset"))
    if trial.has_truth and trial.t_s is None and trial.t_c is not None:
        reasons.append((NEVER, "does not slip, but the labels have an onset"))
    for source, error, (low, high) in (
        ("labels", trial.label_error_ms, LABELS_MS),
        ("model" if len(trial.late_by) == 1 else "models", trial.model_error_ms, TIMING_MS),
    ):
        if error == np.inf:
            reasons.append((NEVER, f"slip not found by the {source}"))
        elif error is not None and not low <= error <= high:
            beyond = max(low - error, error - high)
            reasons.append((beyond, f"{source} {abs(error):,g} ms {'early' if error < low else 'late'}"))
    return max((score for score, _ in reasons), default=0.0), "; ".join(
        text for _, text in sorted(reasons, reverse=True)
    )
