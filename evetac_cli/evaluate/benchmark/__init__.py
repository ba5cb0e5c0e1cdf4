"""evaluate benchmark: five scores of methods on the folder of a benchmark."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import parameter
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, having


@dataclass(frozen=True)
class EvaluateBenchmark:
    """Score methods on a benchmark's folder: onset of slip, warnings, shear force, dots, and grip in closed loop.

    Without --predictions, evetac's methods process the recordings; their predictions are also written as tables next to
    the report. The five scores are defined in docs/benchmark.md.
    """

    predictions: Path | None = parameter(
        None,
        "Score the tables in this folder (onset, warning, force, dots; CSV), or a single table, instead of evetac's"
        " methods.",
        recipe=False,
    )
    model: Path | None = parameter(
        None,
        "Slip detector: a model file, `shipped` for the pretrained one (default), or `none` to leave out onset and"
        " warning.",
        recipe=False,
    )
    threshold: float | None = parameter(
        None, "Use this threshold for the onset, and in closed loop, instead of the model's own.", low=0.0, high=1.0
    )
    tracker: str = parameter(
        "stable",
        f"Preset of the dot tracker; {names.words(names.TRACKERS)}.",
        choices=tuple(names.TRACKERS),
    )
    shear_force: str = parameter(
        "touch",
        "Method of shear force. touch: touch maps. regression, network: the paper's, with --force-model. none: leave"
        " the task out.",
        choices=("touch", "regression", "network", "none"),
    )
    force_model: Path | None = parameter(
        None, "Force model trained by the paper's method (`train-force`).", recipe=False
    )
    controller: str = parameter(
        "", f"Play the lifts with this controller, for the grip score: {', '.join(names.CONTROLLERS)}, or a plug-in's."
    )


SUBJECT = Subject(
    "benchmark",
    EvaluateBenchmark,
    "evaluate.benchmark.command",
    "The folder of a benchmark.",
    kind="",
    examples=(
        "evetac evaluate benchmark bench-small",
        "evetac evaluate benchmark bench-small --predictions mine",
        "evetac evaluate benchmark bench-small --tracker paper --controller load-proportional",
    ),
    panel=OWN_DATA,
    title="Benchmark",
    about=(
        "Five scores on recordings of sensors and objects that no method of evetac was trained on, with 95 % intervals"
        " over sensors and objects."
    ),
    tables=(
        SubjectTable(
            "Scores by task and split",
            having("task", "split"),
            (
                *("task", "split", "value", "low", "high", "unit", "n", "left_out", "left_out_because"),
                *("sensors", "objects"),
            ),
        ),
    ),
)
