"""evaluate labels: labelled onsets against the true ones."""

from dataclasses import dataclass

from evetac_cli.evaluate.subject import OWN_DATA, Subject, SubjectTable


@dataclass(frozen=True)
class EvaluateLabels:
    """Compare labelled onsets with the true onset of gross slip (simulated recordings)."""


SUBJECT = Subject(
    "labels",
    EvaluateLabels,
    "evaluate.labels.measure",
    "Labels of simulated recordings.",
    kind="labels",
    examples=("evetac evaluate labels data",),
    panel=OWN_DATA,
    title="Labels against the truth",
    about="t_c - t_s, in simulations only.",
    tables=(
        SubjectTable(
            "Labelled onset against gross slip",
            lambda rows, summary: [summary],
            (
                *("method", "trajectories", "slips", "counted", "abstained"),
                *("rest_within_half_px", "rest_over_10_ms_early", "rest_within_minus4_plus3_ms"),
                *("intervals_counted", "interval_coverage", "interval_width_px_median"),
                *(
                    "onsets_found",
                    "onset_error_ms_median",
                    "onset_error_ms_worst",
                    "earlier_than_4_ms_before_gross_slip",
                ),
            ),
        ),
    ),
)
