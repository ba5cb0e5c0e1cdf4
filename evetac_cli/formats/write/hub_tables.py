"""Write trials as Parquet tables for the viewer of a hub: one row per trial, per slice, or per event.

    tables/trials/SPLIT.parquet           one row per trial: its facts, its length, and the file of its recording
    tables/slices/SPLIT/TRIAL.parquet     one row per slice: gripper, forces, labels, touch (slice_columns.py, no dots)
    tables/dots/SPLIT/TRIAL.parquet       one row per slice: the columns of each dot, if a trial has some
    tables/events/SPLIT/TRIAL.parquet     one row per event, if requested

Each table is a configuration of the card, and the splits are those of the card. All columns are plain numbers, booleans
or text. All files of a table have the same columns, and data that a trial lacks is null.

Why dots are a separate table: the Hub's viewer shows no table with more than 1,000 columns, and people look at a few
dozen. The tables can be joined on trial and time. Why object and sensor are columns and not folders as in
write_table.py: the Hub does not turn folders into columns. Why file names are flat: readers interpret `**` in a pattern
differently.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.formats.write.slice_columns import Opener, SliceColumns, TrialFiles, columns_of, not_in_tables
from evetac_cli.formats.write.write_table import (
    COMPRESSION,
    field_of,
    load_pyarrow,
    repeated,
    table_schema,
    to_arrow,
    typed,
    write_rows,
)
from evetac_cli.jobs import Progress, silent
from evetac_cli.store.recordings.read import Recording

FOLDER = "tables"
TRIALS, SLICES, DOTS, EVENTS = "trials", "slices", "dots", "events"
MOST_COLUMNS = 1000  # most that the Hub's viewer shows: huggingface/dataset-viewer issue 1143
EVENTS_A_GROUP = 1_000_000  # written at once, as one row group: 13 bytes each
# Columns of the trials in addition to the facts that identify them: type, unit, meaning.
OF_TRIAL = {
    "split": ("string", "", "part of the data set: train, validation, test"),
    "slices": ("int64", "ms", "length of the trial"),
    "events": ("int64", "", "events of the trial"),
    "recording": ("string", "", "file of the recording in this data set; files computed from it are next to it"),
    "recipe_id": ("string", "", "recipe id of the recording"),
}
OF_EVENT = {
    "t_us": ("t", np.dtype(np.int64), "us", "time since the start of the recording"),
    "x": ("x", np.dtype(np.uint16), "px", "column, right is positive"),
    "y": ("y", np.dtype(np.uint16), "px", "row, down is positive"),
    "p": ("p", np.dtype(np.uint8), "", "1 brighter, 0 darker"),
}


class SharedTrial(NamedTuple):
    """A recording to share: its name (without ending) and its path in the folder, its file on disk, and its split."""

    name: str
    path: str
    source: Path
    split: str


class HubTables:
    """The tables of trials: examined first, because the card describes their contents, then written."""

    def __init__(
        self, trials: Sequence[SharedTrial], opened: Opener, *, events: bool, progress: Progress = silent
    ) -> None:
        """Examine all trials; raise MissingLibrary before opening any if pyarrow is not installed."""
        self._arrow = load_pyarrow(FOLDER)
        self._trials, self._opened, self._files = trials, opened, _flat([trial.name for trial in trials])
        self._facts: list[dict[str, Any]] = []
        self.left_out: list[str] = []
        self.rows = dict.fromkeys((TRIALS, SLICES), 0)
        plain, dots = [], []
        for number, trial in enumerate(trials):
            progress(number, len(trials), "trials")
            with opened(trial.source) as files:
                facts, parts = {**files.facts(), "trial": trial.name}, _parted(files)
                plain.append(table_schema(self._arrow, parts[SLICES], {}))
                dots.append(table_schema(self._arrow, parts[DOTS], {}))
                self.left_out += [f"{trial.name}: {one}" for one in (*files.notes, *not_in_tables(files.recording))]
                self._facts.append({**facts, **_length(files.recording, trial)})
        self._types = typed([self._trial_facts(facts) for facts in self._facts])
        head = table_schema(self._arrow, [], self._types)
        self._tables = {
            SLICES: self._arrow.unify_schemas([head, *plain]),
            DOTS: self._arrow.unify_schemas([head, *dots]),
        }
        slices = sum(facts["slices"] for facts in self._facts)
        self.rows = {TRIALS: len(trials), SLICES: slices}
        if len(self._tables[DOTS]) > len(head):
            self.rows[DOTS] = slices
        if events:
            self.rows[EVENTS] = sum(facts["events"] for facts in self._facts)

    @property
    def splits(self) -> list[str]:
        """The splits, in the order of the trials."""
        return list(dict.fromkeys(trial.split for trial in self._trials))

    @property
    def note(self) -> str:
        """A text on tables that the Hub's viewer does not show; empty if it shows all."""
        wide = [name for name, table in self._tables.items() if name in self.rows and len(table) > MOST_COLUMNS]
        return "; ".join(
            f"the Hub's viewer does not show the table {name}: it has {len(self._tables[name])} columns, and the viewer"
            f" shows at most {MOST_COLUMNS}"
            for name in wide
        )

    def configs(self) -> list[dict[str, Any]]:
        """Return the field `configs` of a card: the files of each split of each table."""
        return [
            {
                "config_name": name,
                "data_files": [
                    {"split": split, "path": f"{FOLDER}/{name}/{split}{'' if name == TRIALS else '/*'}.parquet"}
                    for split in self.splits
                ],
                **({"default": True} if name == TRIALS else {}),
            }
            for name in self.rows
        ]

    def columns(self) -> dict[str, int]:
        """Return the number of columns of each table."""
        own = {TRIALS: len(self._trial_schema()), EVENTS: len(OF_EVENT) + 1}
        return {name: own[name] if name in own else len(self._tables[name]) for name in self.rows}

    def write(self, folder: Path, progress: Progress) -> int:
        """Write all tables into a folder; return their size in bytes."""
        self._write_trials(folder)
        done, of = 0, sum(facts["slices"] for facts in self._facts)
        for trial, facts, file in zip(self._trials, self._facts, self._files, strict=True):
            progress(done, of, "slices")
            paths = {name: folder / FOLDER / name / trial.split / f"{file}.parquet" for name in self.rows}
            del paths[TRIALS]
            for path in paths.values():
                path.parent.mkdir(parents=True, exist_ok=True)
            trial_facts = self._trial_facts(facts)
            with self._opened(trial.source) as files:
                for name, columns in _parted(files).items():
                    if name in paths:
                        write_rows(self._arrow, self._tables[name], files, columns, trial_facts, paths[name], silent)
                if EVENTS in paths:
                    self._write_events(files.recording, trial.name, paths[EVENTS])
            done += facts["slices"]
        return sum(path.stat().st_size for path in (folder / FOLDER).rglob("*.parquet"))

    @staticmethod
    def _trial_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
        """Return the facts that identify a trial, without the columns of OF_TRIAL."""
        return {name: value for name, value in facts.items() if name not in OF_TRIAL}

    def _trial_schema(self) -> Any:
        arrow = self._arrow
        fact_columns = {name: (type_, "", f"{name} of the trial") for name, type_ in self._types.items()}
        fields = {name: arrow.type_for_alias(type_) for name, (type_, _, _) in (fact_columns | OF_TRIAL).items()}
        unit_and_meaning = {name: (unit, meaning) for name, (_, unit, meaning) in (fact_columns | OF_TRIAL).items()}
        return arrow.schema([field_of(arrow, name, type_, *unit_and_meaning[name]) for name, type_ in fields.items()])

    def _write_trials(self, folder: Path) -> None:
        arrow, schema = self._arrow, self._trial_schema()
        (folder / FOLDER / TRIALS).mkdir(parents=True, exist_ok=True)
        for split in self.splits:
            split_facts = [facts for facts in self._facts if facts["split"] == split]
            columns = [
                arrow.concat_arrays([repeated(arrow, facts[field.name], field.type, 1) for facts in split_facts])
                for field in schema
            ]
            path = folder / FOLDER / TRIALS / f"{split}.parquet"
            with arrow.parquet.ParquetWriter(path, schema, compression=COMPRESSION) as writer:
                writer.write_batch(arrow.record_batch(columns, schema=schema))

    def _write_events(self, recording: Recording, name: str, path: Path) -> None:
        arrow = self._arrow
        fields = [field_of(arrow, "trial", arrow.string(), "", "name of the trial")]
        fields += [
            field_of(arrow, column, arrow.from_numpy_dtype(type_), unit, meaning)
            for column, (_, type_, unit, meaning) in OF_EVENT.items()
        ]
        schema = arrow.schema(fields)
        with arrow.parquet.ParquetWriter(path, schema, compression=COMPRESSION) as writer:
            for first, stop in _blocks(recording.event_count):
                columns = [repeated(arrow, name, arrow.string(), stop - first)]
                columns += [
                    to_arrow(arrow, recording.read(f"events/{stored}", first, stop)) for stored, *_ in OF_EVENT.values()
                ]
                writer.write_batch(arrow.record_batch(columns, schema=schema))


def _parted(files: TrialFiles) -> dict[str, list[SliceColumns]]:
    columns = columns_of(files)
    return {name: [group for group in columns if group.of_dots == (name == DOTS)] for name in (SLICES, DOTS)}


def _length(recording: Recording, trial: SharedTrial) -> dict[str, Any]:
    return {
        "split": trial.split,
        "slices": len(recording),
        "events": recording.event_count,
        "recording": f"data/{trial.path}",
        "recipe_id": recording.header["id"],
    }


def _blocks(events: int) -> Iterator[tuple[int, int]]:
    for first in range(0, events, EVENTS_A_GROUP):
        yield first, min(first + EVENTS_A_GROUP, events)


def _flat(names: Sequence[str]) -> list[str]:
    """Return a unique name without folders for each trial."""
    taken: set[str] = set()
    flat = []
    for name in names:
        base = name.replace("/", "-")
        numbered = (base, *(f"{base}-{number}" for number in range(2, len(names) + 2)))
        flat.append(next(one for one in numbered if one not in taken))
        taken.add(flat[-1])
    return flat
