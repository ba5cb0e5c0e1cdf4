"""All subjects of `evaluate`, in the order of its help and of the report page, and all figures of the paper."""

from collections import ChainMap

from evetac_cli.evaluate import (
    benchmark,
    cost,
    data_rate,
    force,
    grasp,
    labels,
    likeness,
    realism,
    slip,
    stability,
    tracking,
    vibration,
)
from evetac_cli.evaluate.common.marks import Paper
from evetac_cli.evaluate.subject import Subject

SUBJECTS: tuple[Subject, ...] = tuple(
    folder.SUBJECT
    for folder in (
        *(slip, labels, tracking, grasp, force, vibration, data_rate),
        *(realism, likeness, benchmark, cost, stability),
    )
)
PAPER = Paper(
    ChainMap(*(dict_ for subject in SUBJECTS for dict_ in [subject.paper.figures])),
    ChainMap(*(subject.paper.columns for subject in SUBJECTS)),
)
