"""The card of a data set: trials, objects, sensors and seeds, limitations, and how to read and cite it."""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from evetac_cli.commands.share import Share
from evetac_cli.console import format_value
from evetac_cli.errors import InputError, MissingLibrary
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import Card, card_fields, inline, opening, table
from evetac_cli.formats.write.write_table import load_pyarrow, write_data_set
from evetac_cli.inspect.share.sections import SharedTrial, citation, limitations, look, made_with, trials_of
from evetac_cli.jobs import Progress
from evetac_cli.store.data_set import FileRow, foreign_note, read_data_set

MOST_LISTED = 20  # objects or sensors
TABLES = "tables"

READ = """Each trial is a set of HDF5 files with the same name. `evetac info DATA` lists them, `evetac view` shows one.
Without evetac:

```python
import h5py

with h5py.File("data/NAME.recording.h5") as file:
    t_us, x, y, p = (file[f"events/{column}"][:] for column in "txyp")
```

Every dataset has `units` and `long_name`, and the root attribute `header` describes how the file was made. To open
a file with xarray, use `engine="h5netcdf"`. A short reader of each kind of file is in docs/read-without-evetac.md of
evetac."""
READ_TABLES = """The tables are Parquet, with a file per trial and a row per slice of 1 ms. Columns end in their units,
unknown values are null, and the metadata of each column describe it. `pandas.read_parquet("tables/SPLIT")` reads those
of a split; from the Hub, `datasets.load_dataset("NAME")` reads all of them."""


def describe(folder: Path, params: Share, progress: Progress) -> Card:
    """Return the card of a folder of stage files; InputError if one is unreadable."""
    every = read_data_set(folder, progress)
    passed_over = foreign_note(every)
    rows = [row for row in every if row.kind is not None or row.error is not None]
    broken = next((row for row in rows if row.error is not None), None)
    if broken is not None:
        hint = "move the file out of the folder, or make it again"
        raise InputError(
            "a damaged file cannot be shared", where=str(folder / broken.path), found=broken.error or "", hint=hint
        )
    if not rows:
        raise InputError("the folder has nothing to share", where=str(folder), expected="stage files")
    links = {f"data/{path}": folder / path for path in (row.path for row in rows)}
    contents = look(folder, rows, progress)
    recordings = [row for row in rows if row.kind == "recording"]
    shared = trials_of(folder, recordings)
    note = _lacks_pyarrow() if shared else ""
    tables = () if note else shared
    splits = list(dict.fromkeys(trial.split for trial in tables))
    simulated = any(row.simulated for row in rows)
    title = params.title or folder.resolve().name
    trials = {row.recording or row.path: row for row in rows if row.kind != "recording" and row.recording}
    trials |= {row.recording or row.path: row for row in recordings}
    files = [{"split": split, "path": f"{TABLES}/{split}/*.parquet"} for split in splits]
    fields = {
        **card_fields(simulated, params.license),
        "pretty_name": title,
        "task_categories": ["robotics"],
        # Otherwise the Hub would guess from the HDF5 files, and show an error on its page.
        **({"configs": [{"config_name": "slices", "data_files": files}]} if tables else {"viewer": False}),
    }
    kinds = [
        {"kind": kind, "files": count, "size_bytes": sum(row.size_bytes for row in rows if row.kind == kind)}
        for kind, count in sorted(Counter(str(row.kind) for row in rows).items())
    ]
    figures = [{"": name, "value": value} for name, value in _figures(list(trials.values())).items() if value]
    split = list(zip((trial.split for trial in shared), recordings, strict=True))
    page = [
        *opening(title, simulated=simulated, license_=params.license),
        "Tactile data of an event camera behind a dotted gel (Evetac), made with evetac.",
        "## Contents",
        table(figures, format_value),
        table(kinds, format_value),
        "## How to read it",
        READ.replace("NAME", inline(rows[0].path.removesuffix(f".{rows[0].kind}.h5"))),
        *([READ_TABLES.replace("SPLIT", splits[0])] if splits else []),
        *(limitations(contents, list(trials.values()), split) if trials else []),
        *citation(params.author, "data set"),
        *made_with(),
    ]
    notes = "; ".join(filter(None, (passed_over, note)))
    return Card(
        "data set", title, simulated, fields, page, links, {}, notes, partial(_write, tables) if tables else None
    )


def _lacks_pyarrow() -> str:
    """Return a note on tables that cannot be written; empty if pyarrow is installed.

    This is not an error, because all measurements are in the HDF5 files, and the card then disables the Hub's viewer.
    """
    try:
        load_pyarrow(TABLES)
    except MissingLibrary as error:
        return f"no tables were written, so the Hub's viewer shows nothing: {error.message}; try: {error.hint}"
    return ""


def _write(trials: Sequence[SharedTrial], folder: Path, progress: Progress) -> str:
    """Write the tables into a shared folder; return a note on data that they do not have."""
    from evetac_cli.inspect.export import trial_files  # imported here because it loads all formats

    sources, places = [one.source for one in trials], [(one.split, one.name) for one in trials]
    left_out = write_data_set(sources, trial_files, folder / TABLES, progress, places).left_out
    more = f", and {len(left_out) - 1} more" if len(left_out) > 1 else ""
    return f"not in the tables: {left_out[0]}{more}" if left_out else ""


def _figures(trials: Sequence[FileRow]) -> dict[str, Any]:
    return {
        "trials": len(trials),
        "duration_s": sum(row.slices or 0 for row in trials) / SLICES_PER_S,
        **{f"{name}s": _listed(trials, name) for name in ("scene", "object", "sensor", "seed", "outcome")},
    }


def _listed(trials: Sequence[FileRow], name: str) -> str:
    """Return the values of a column with their number of trials; many numbers as a range."""
    counts = Counter(value for trial in trials if (value := getattr(trial, name)) is not None)
    if len(counts) > MOST_LISTED and all(isinstance(value, int) for value in counts):
        return f"{min(counts)} to {max(counts)} ({len(counts)})"
    listed = sorted(counts, key=lambda value: (isinstance(value, str), value))
    more = f" and {len(listed) - MOST_LISTED} more" if len(listed) > MOST_LISTED else ""
    return ", ".join(f"{value} ({counts[value]})" for value in listed[:MOST_LISTED]) + more
