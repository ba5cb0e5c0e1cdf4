"""report: show a whole data set or study on one self-contained page, or compare two of them."""

from pathlib import Path
from typing import Any

from evetac_cli.commands.report import Report
from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress, require_possible_name, silent
from evetac_cli.pages import shared
from evetac_cli.pages.report.figures import matched
from evetac_cli.pages.report.page import render
from evetac_cli.pages.report.study import name_sensors, read_study, remark
from evetac_cli.store.hdf5.disk import check_free


def run(
    folders: list[Path], params: Report, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write the page of one folder, or of two with `compare`; raise InputError if it exists, unless `force`."""
    shared.check_libraries(("matplotlib", "PIL"))
    _check(folders, params)
    if params.compare:
        place, name = Path(), f"{'-'.join(folder.resolve().name for folder in folders)}.report.html"
    else:
        place, name = folders[0], "report.html"
    target = shared.page_path(place, name, out)
    require_possible_name(target)
    check_free(target, force=force)
    studies = [read_study(folder, progress) for folder in folders]
    if len({study.name for study in studies}) < len(studies):
        for study in studies:
            study.name = str(study.folder)
    name_sensors(studies)
    content = render(studies, target)
    shared.write_page(target, content, force=force)
    row: dict[str, Any] = {
        "page": str(target),
        "size_bytes": len(content),
        "trials": sum(len(study.trials) for study in studies),
        "abstained": sum(bool(trial.doubt) for study in studies for trial in study.trials),
        "outliers": sum(remark(trial)[0] > 0 for study in studies for trial in study.trials),
        "reports": sum(len(study.evaluations) for study in studies),
        "unreadable": sum(len(study.unreadable) for study in studies),
    }
    if params.compare:
        pairs, words = matched(studies)
        row |= {"pairs": len(pairs), "without_partner": row["trials"] - 2 * len(pairs), "pairing": words}
    return Outcome([row], any(study.simulated for study in studies))


def _check(folders: list[Path], params: Report) -> None:
    """Raise InputError unless the folders exist and their number is correct."""
    wanted = "two folders" if params.compare else "one folder"
    for folder in folders:
        if not folder.is_dir():
            hint = f"evetac view {folder} shows one trial" if folder.suffix == ".h5" else ""
            fault = "not a folder" if folder.exists() else "no such folder"
            raise InputError(fault, where=str(folder), expected="a folder of stage files", hint=hint)
    if len(folders) != 1 + params.compare:
        where, found = f"evetac report{' --compare' * params.compare}", str(len(folders))
        raise InputError("wrong number of folders", where=where, expected=wanted, found=found)
