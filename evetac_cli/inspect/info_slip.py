"""What info says of the slip of a recording, and of the slips of a folder: their covariates.

Of a recording whose slip is known from truth, or from labels beside it. Of a folder, which may hold a million of them,
as many as take half a second, evenly among them.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.kernels.slip.covariates import SlipCovariates, not_told, summary
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import Recording
from evetac_cli.store.recordings.slip_covariates import covariates_of_labels, covariates_of_truth

MOST_SLIPS = 40  # of a folder that are looked at


def slip_of(recording: Recording) -> tuple[str, SlipCovariates | None]:
    """Whether `truth` or `labels` tell of the slip of a recording, and its covariates; None where it is not known."""
    if recording.has("truth"):
        return "truth", covariates_of_truth(recording)
    path = output_path(recording.path, "labels", None)
    if path.exists():
        with suppress(EvetacError), StageFile(path, "labels") as labels:  # `validate` says what is wrong with them
            check_made_from(labels, recording)
            return "labels", covariates_of_labels(recording, labels)
    return "", None


def figures(recording: Recording) -> dict[str, Any]:
    """The covariates of the slip of a recording, beside what tells them and what cannot be told; nothing without."""
    source, slip = slip_of(recording)
    if slip is None:
        return {}
    missing = not_told([slip])
    return {
        "slip_onset_ms": slip.onset_ms,
        "slip_told_by": source,
        **slip.figures(),
        **({"slip_not_told": ", ".join(missing)} if missing else {}),
    }


def of_folder(folder: Path, names: Sequence[str], progress: Callable[[int, int], None]) -> tuple[Rows, dict[str, Any]]:
    """Rows of covariates over recordings of a folder that slip, and of how many; nothing where none can be told."""
    count = min(len(names), MOST_SLIPS)
    chosen = [names[number * len(names) // count] for number in range(count)]
    slips = []
    for number, name in enumerate(chosen):
        progress(number, len(chosen))
        with suppress(EvetacError), Recording(folder / name) as recording:  # one that cannot be read is counted as such
            _, slip = slip_of(recording)
            slips += [slip] if slip is not None else []
    if not slips:
        return [], {}
    missing = not_told(slips)
    said = {"covariates_not_told": ", ".join(missing)} if missing else {}
    return summary(slips), {"covariates_of": f"{len(slips)} of {len(names)} recordings that slip", **said}
