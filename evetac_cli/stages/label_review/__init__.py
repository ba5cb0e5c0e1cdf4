"""label --review: a page on which a person checks the onset of each recording, moves it, and keeps it as a label.

It works for real recordings, which have no truth, and never shows the truth of simulated ones. A label that a person
keeps is a labels file of the method `person`, with the person's name and the replaced labels in its header. A recording
without labels is shown with those of `event-flow`, which are stored only if the person keeps them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.label import Label
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome
from evetac_cli.store.files import output_path
from evetac_cli.store.recordings.read import open_recording


@dataclass(frozen=True)
class ReviewJob(Job):
    """All recordings that a person reviews, one after the other; labels: the file of each."""

    exclusive = True  # there is only one person
    labels: tuple[Path, ...]

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The labels of each recording."""
        return self.labels


def jobs(files: Sequence[Path], out: Path | None) -> list[ReviewJob]:
    """Return one job for all recordings."""
    labels = tuple(output_path(file, "labels", out) for file in files)
    return [ReviewJob(tuple(files), labels[0], labels)] if labels else []


def run(job: ReviewJob, params: Label) -> Outcome:
    """Serve the page until the person is done, with a row for every kept label."""
    from evetac_cli.realtime.local_server import announce
    from evetac_cli.stages.label_review.server import ReviewServer

    for path in job.labels:
        if not path.parent.is_dir():
            raise InputError("no such folder", where=str(path.parent))
    simulated = []
    for file in job.inputs:
        with open_recording(file) as recording:
            simulated.append(bool(recording.header["simulated"]))
    server = ReviewServer(job.inputs, job.labels, params)
    try:
        announce(server.url, server.url_once, "label review")
        server.run()
    finally:
        server.close()
    return Outcome(server.rows, any(simulated))
