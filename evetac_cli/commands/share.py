"""share: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import PAGE, Command, parameter


@dataclass(frozen=True)
class Share:
    """Prepare a model or a folder of files for the Hugging Face Hub, with a card; nothing is uploaded.

    The card describes the model or data: origin, seeds, results, limits and citation, and whether it is simulated.
    Results are added from reports of `evetac evaluate slip` that are given after the model. For a folder, tables in
    Parquet, with one row per slice, are written next to the files for the Hub's viewer (extra `convert`). Subfolders
    named train, validation and test, or learn, choose and unseen, become the splits.
    """

    title: str | None = parameter(None, "Title of the card; default: the name of the file or folder.", recipe=False)
    license: str | None = parameter(
        None,
        "License, by the Hub's name for it, e.g. mit or cc-by-4.0; default: none, which the card states.",
        recipe=False,
    )
    author: str | None = parameter(
        None,
        "Authors, e.g. 'Noether, Emmy and Turing, Alan'; default: none.",
        recipe=False,
    )


COMMAND = Command(
    "share",
    Share,
    "inspect.share",
    "A model, followed by its reports; or a folder.",
    kind="",
    unit="files",
    examples=(
        "evetac share own.model.h5 unseen.slip.report.h5 --license mit -o own-hub",
        'evetac share data --title "Slips of 20 objects" --author "Noether, Emmy" -o data-hub',
    ),
    does=PAGE,
    out="Output folder; default: NAME-hub next to the input.",
)
