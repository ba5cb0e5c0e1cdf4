"""evaluate realism: a simulated recording against a real one."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import SIMULATOR, Subject, SubjectTable, having


@dataclass(frozen=True)
class EvaluateRealism:
    """Compare a simulated recording with a real one: rates, intervals, dot edges, separability by a classifier."""

    same: Path | None = parameter(
        None, "Another recording of the real sensor with the same motion, as a reference: how well two real recordings"
        " can be distinguished.",
        recipe=False,
    )  # fmt: skip


SUBJECT = Subject(
    "realism",
    EvaluateRealism,
    "evaluate.realism.measure",
    "A real recording, then a simulated one.",
    examples=("evetac evaluate realism real.recording.h5 simulated.recording.h5",),
    panel=SIMULATOR,
    title="Simulated against real",
    about="Differences between figures of a simulated recording and a real one.",
    tables=(SubjectTable("Figures", having("figure", "distance")),),
)
