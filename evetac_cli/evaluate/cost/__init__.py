"""evaluate cost: error against run time of one part."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import SIMULATOR, Subject, SubjectTable, having


@dataclass(frozen=True)
class EvaluateCost:
    """Measure error and run time for the numerical settings of one part, as a table, a report and a plot."""

    part: str = parameter(
        "sim",
        "Part to measure. sim: the simulator. track: the dot tracker. model: slip detectors. grasp: grasps with a"
        " delayed detector, a slow controller or other detectors.",
        choices=("sim", "track", "model", "grasp"),
        flag="PART",
    )
    model: Path | None = parameter(
        None,
        "Part model: model file, folder of models, glob, or `shipped` for the pretrained one, together with their"
        " report of `evaluate slip`; without it, untrained models are measured. Part grasp: detectors to try in"
        " addition to the pretrained one.",
        recipe=False,
    )
    trials: int | None = parameter(
        None,
        "Simulated trials per setting; default: as many as fit into three minutes.",
        low=1,
        high=10000,
    )
    seed: int = parameter(
        10000,
        "Seed of the first trial. Constants of evetac were chosen on seeds below 10,000;"
        " docs/evidence/results.md lists the exceptions.",
        low=0,
        high=2**31 - 1 - 10000,
    )
    full: bool = parameter(False, "Measure more settings with finer references and more trials; takes many minutes.")


SUBJECT = Subject(
    "cost",
    EvaluateCost,
    "evaluate.cost.command",
    "For part model: the report of `evaluate slip`, and models.",
    kind="report",
    unit="rows",
    files_needed=False,
    examples=("evetac evaluate cost sim", "evetac evaluate cost model unseen.slip.report.h5 --model models"),
    panel=SIMULATOR,
    title="Error against run time",
    about="Run times depend on the computer and its load when they were measured.",
    tables=(SubjectTable("Settings", having("setting")),),
)
