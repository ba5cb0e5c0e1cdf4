"""The card of a data set: its trials, objects, sensors and seeds, how large it is, and how to read it."""

from collections import Counter
from pathlib import Path
from typing import Any

from evetac_cli.commands.share import Share
from evetac_cli.console import format_value
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.formats.write.hub_card import Card, card_fields, inline, opening, table
from evetac_cli.formats.write.write_table import is_simulated
from evetac_cli.inspect.index import indexed
from evetac_cli.jobs import Progress
from evetac_cli.store.index import foreign_note

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
LARGER = "1M<n<10M"
OTHERS = (".parquet", ".csv")  # what `export` writes for other programs: shared with the rest
MOST_LISTED = 20  # objects or sensors

READ = """Each trial is a set of HDF5 files of one name. `evetac info DATA` lists them, `evetac view` shows one. Without
evetac:

```python
import h5py

with h5py.File("data/NAME.recording.h5") as file:
    t_us, x, y, p = (file[f"events/{column}"][:] for column in "txyp")
```

Every dataset has `units` and `long_name`, the attribute `header` of the root says how the file was made, and xarray
opens it with `engine="h5netcdf"`."""


def describe(folder: Path, params: Share, progress: Progress) -> Card:
    """The card of a folder of stage files, and of tables exported from them; InputError where one cannot be read."""
    with indexed(folder, progress) as index:
        rows, passed_over = index.rows("kind IS NOT NULL OR error IS NOT NULL"), foreign_note(index)
    broken = next((row for row in rows if row.error is not None), None)
    if broken is not None:
        hint = "move it away, or make it again"
        raise InputError("cannot be shared", where=str(folder / broken.path), found=broken.error or "", hint=hint)
    others = sorted(
        path for path in folder.rglob("*") if path.suffix in OTHERS and path.is_file() and not path.name.startswith(".")
    )
    if not rows and not others:
        raise InputError("nothing to share in this folder", where=str(folder), expected="stage files, or tables")
    links = {f"data/{path}": folder / path for path in (row.path for row in rows)}
    links |= {f"data/{path.relative_to(folder)}": path for path in others}
    trials = {row.recording or row.path: row for row in rows if row.kind != "recording" and row.recording}
    trials |= {row.recording or row.path: row for row in rows if row.kind == "recording"}
    simulated = any(row.simulated for row in rows) or any(is_simulated(path) for path in others)
    title = params.title or folder.resolve().name
    seconds = sum(row.slices or 0 for row in trials.values()) / SLICES_PER_S
    figures: dict[str, Any] = {
        "trials": len(trials),
        "duration_s": seconds,
        "scenes": _listed(trials.values(), "scene"),
        "objects": _listed(trials.values(), "object"),
        "sensors": _listed(trials.values(), "sensor"),
        "seeds": _listed(trials.values(), "seed"),
        "outcomes": _listed(trials.values(), "outcome"),
    }
    kinds = [
        {"kind": kind, "files": count, "size_bytes": sum(row.size_bytes for row in rows if row.kind == kind)}
        for kind, count in sorted(Counter(str(row.kind) for row in rows).items())
    ]
    kinds += [
        {"kind": suffix[1:], "files": len(alike), "size_bytes": sum(path.stat().st_size for path in alike)}
        for suffix in OTHERS
        if (alike := [path for path in others if path.suffix == suffix])
    ]
    about = {
        "what": "data set",
        "title": title,
        "simulated": simulated,
        "license": params.license,
        "figures": figures,
        "files": kinds,
        "recipe_ids": sorted({row.recipe_id for row in rows if row.kind == "recording" and row.recipe_id}),
    }
    fields = {
        **card_fields(simulated, params.license),
        "pretty_name": title,
        "task_categories": ["robotics"],
        "size_categories": [next((name for most, name in SIZES if len(trials) < most), LARGER)],
    }
    tables = [path for path in others if path.suffix == ".parquet"]
    if tables:
        fields["configs"] = [{"config_name": "default", "data_files": "data/**/*.parquet"}]
    page = [
        *opening(title, simulated=simulated, license_=params.license),
        "Touch seen by an event camera behind a dotted gel (Evetac), made with evetac.",
        "## What is in it",
        table([{"": name, "value": value} for name, value in figures.items() if value not in ("", 0)], format_value),
        table(kinds, format_value),
        "## How to read it",
        READ.replace("NAME", inline(Path(rows[0].path).name.split(".")[0])) if rows else "Tables, a row a slice.",
    ]
    return Card(fields, page, about, links, {}, passed_over)


def _listed(trials: Any, name: str) -> str:
    """The values of a column, each with how many trials have it; numbers as a range where they are many."""
    counts = Counter(value for trial in trials if (value := getattr(trial, name)) is not None)
    if len(counts) > MOST_LISTED and all(isinstance(value, int) for value in counts):
        return f"{min(counts)} to {max(counts)} ({len(counts)})"
    listed = sorted(counts, key=lambda value: (isinstance(value, str), value))
    more = f" and {len(listed) - MOST_LISTED} more" if len(listed) > MOST_LISTED else ""
    return ", ".join(f"{value} ({counts[value]})" for value in listed[:MOST_LISTED]) + more
