"""evaluate grasp: outcomes of grasps, and their grip forces."""

from dataclasses import dataclass

from evetac_cli.evaluate.grasp.paper import PAPER
from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable, having


@dataclass(frozen=True)
class EvaluateGrasp:
    """Report the outcome of grasps: lifted, balanced, and how far the object moved (simulated recordings)."""


SUBJECT = Subject(
    "grasp",
    EvaluateGrasp,
    "evaluate.grasp.measure",
    "Recordings made by grasp.",
    examples=("evetac evaluate grasp grasps",),
    panel=OWN_DATA,
    title="Grasps",
    about="Objects lifted and kept using touch, by controller and object."
    " Grip, opening and motion are over the n kept.",
    tables=(
        SubjectTable(
            "Controllers and settings",
            having("setting", "columns"),
            (
                *("setting", "trials", "success", "lifted", "lifted_trials", "balanced", "held_trials", "lost"),
                *("force_end_n", "moved_mm_median", "moved_mm_mean", "reopened_columns", "reopened_share"),
            ),
        ),
        SubjectTable(
            "By object",
            having("setting", "object", "trials"),
            (
                *("setting", "object", "trials", "success", "held_trials", "opening_after_balance_ticks"),
                *("force_end_n", "moved_mm_median"),
            ),
        ),
    ),
    paper=PAPER,
)
