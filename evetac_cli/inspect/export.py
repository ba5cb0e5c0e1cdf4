"""export: write recordings in formats that other programs read."""

from pathlib import Path

from evetac_cli.errors import InputError
from evetac_cli.formats.exports import export, target_path
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.params.inspection import Export


def run(
    files: list[Path], params: Export, out: Path | None, *, force: bool = False, progress: Progress = silent
) -> Outcome:
    """Write a file for every recording; InputError, before anything is written, if two would have the same name."""
    targets = [target_path(file, params.format, out) for file in files]
    twice = sorted({str(target) for target in targets if targets.count(target) > 1})
    if twice:
        raise InputError("several recordings would write the same output", found=", ".join(twice))
    rows = [
        export(file, params.format, target, force=force, progress=progress)
        for file, target in zip(files, targets, strict=True)
    ]
    simulated = any(row.pop("simulated") for row in rows)
    return Outcome(rows, simulated, {"files": len(rows)})
