"""report: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import PAGE, Command, parameter


@dataclass(frozen=True)
class Report:
    """Summarize a data set or study on one HTML page: trials, onsets and evaluations. The page works offline."""

    compare: bool = parameter(False, "Compare two folders side by side.", recipe=False)


COMMAND = Command(
    "report",
    Report,
    "pages.report",
    "A folder of stage files; two with --compare.",
    kind="",
    unit="files",
    examples=("evetac report data", "evetac report before after --compare -o compared.html"),
    does=PAGE,
    out="Output file or folder; default: report.html in the folder, or A-B.report.html in the current one.",
    force="Replace an existing page.",
)
