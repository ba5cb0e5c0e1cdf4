"""share: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Share:
    """Lay out a model, or a folder of files, as the Hugging Face Hub wants it, with a card; nothing is uploaded.

    The card says what it is, with data, seeds, figures, limits and how it is cited, and that it is simulated where it
    is. Reports of `evetac evaluate slip` on the model, named after it, add their figures. Beside the files of a folder
    lie tables in Parquet, which the Hub's viewer shows (extra `convert`). Folders called train, validation and test, or
    learn, choose and unseen, are the splits.
    """

    title: str | None = parameter(None, "Title of the card; default: the name of the file or folder.", recipe=False)
    license: str | None = parameter(
        None, "License by the Hub's name, as in mit or cc-by-4.0; default: none, and the card says so.", recipe=False
    )
    author: str | None = parameter(
        None,
        "Who made it, as BibTeX has names: 'Noether, Emmy and Turing, Alan'; default: nobody is named.",
        recipe=False,
    )
    tables: str = parameter(
        "slices",
        "Of a folder: tables for the Hub's viewer. slices: one row per trial, and one per slice (1 ms); events: one per"
        " event too, which takes about as much space again as the recordings; none: HDF5 alone.",
        choices=("slices", "events", "none"),
        recipe=False,
    )


COMMAND = Command(
    "share",
    Share,
    "inspect.share",
    "A model and reports on it; or a folder.",
    kind="",
    unit="files",
    examples=(
        "evetac share own.model.h5 unseen.slip.report.h5 --license mit -o own-hub",
        'evetac share data --title "Slips of 20 objects" --author "Noether, Emmy" -o data-hub',
    ),
)
