"""One module per subject of `evaluate`: each reads stage files and returns flat rows, which a report file stores."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli.console import plain
from evetac_cli.jobs import Job, Outcome, Rows
from evetac_cli.store.files import StageFile, stem, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe

MOST_FOLDERS = 3  # the file name of a report lists at most this many folders


@dataclass(frozen=True)
class ModelsReportJob(Job):
    """One report over files and models; the last `models` inputs are the model files."""

    models: int


def report_job(files: list[Path], subject: str, out: Path | None, *more: Path, name: str = "") -> list[Job]:
    """Return the job of one report over all files, `<name>.<subject>.report.h5`.

    With a name and without files, it goes into the working folder. Else the name is that of the file. For several files
    it is the name of their folder. For files in several folders it joins the names of the folders, and the report goes
    into the folder that contains them all.
    """
    if out is not None and out.suffix == ".h5":
        return [Job((*files, *more), out)]
    folders = list(dict.fromkeys(file.parent for file in files)) or [Path()]
    beside, name = folders[0], name or stem(files[0])
    if len(files) > 1:
        names = [folder.resolve().name for folder in folders]
        left = len(names) - MOST_FOLDERS
        name = "-".join(names[:MOST_FOLDERS]) + (f"-and-{left}-more" if left > 0 else "") or "files"
    if len(folders) > 1:
        beside = Path(os.path.relpath(os.path.commonpath([folder.absolute() for folder in folders])))
    return [Job((*files, *more), (out or beside) / f"{name}.{subject}.report.h5")]


def report(
    job: Job,
    command: str,
    method: int,
    parameters: dict[str, Any],
    parents: list[Header],
    measure: Callable[[], tuple[Rows, dict[str, Any]]],
    *,
    force: bool,
    simulated_source: bool = False,
) -> Outcome:
    """Measure and write the report; if it is up to date, read its rows and summary instead."""
    recipe = Recipe(
        "report", method, {"command": command, **parameters}, parents=tuple(parents), simulated_source=simulated_source
    )
    if up_to_date(job.output, recipe, force=force):
        with StageFile(job.output, "report") as file:
            rows, summary = json.loads(file.read("rows")), json.loads(file.read("summary"))
        return Outcome(rows, recipe.simulated, summary, made=False)
    rows, summary = measure()
    arrays = {"command": command, "rows": json.dumps(plain(rows)), "summary": json.dumps(plain(summary))}
    made = write_stage(job.output, recipe, arrays, force=force) is not None
    return Outcome(rows, recipe.simulated, {**summary, "report": str(job.output)}, made=made)
