"""share: prepare a model or a data set as a folder for the Hugging Face Hub, with a card; nothing is uploaded.

The folder appears only when it is complete. Files of a data set are hard links if the disk supports them, so that they
take no space twice. Links are safe because evetac never changes files but replaces them by new ones.
"""

import os
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

from evetac_cli.commands.share import Share
from evetac_cli.errors import InputError
from evetac_cli.formats.write.hub_card import Card
from evetac_cli.inspect.share import data_card, model_card
from evetac_cli.jobs import Outcome, Progress, require_possible_name, silent
from evetac_cli.store.files import stem
from evetac_cli.store.made_folders import new_folder, require_free

README = "README.md"


def run(files: list[Path], params: Share, out: Path | None, *, progress: Progress = silent, **_: Any) -> Outcome:
    """Write the folder of a model or a data set; raise InputError if it has anything in it."""
    first = files[0]
    if first.is_dir():
        if len(files) > 1:
            raise InputError("only one data set can be shared at a time", where=str(files[1]), expected="one folder")
        card = data_card.describe(first, params, progress)
    else:
        card = model_card.describe(first, files[1:], params)
    name = first.resolve().name if first.is_dir() else stem(first)
    target = out if out is not None else first.resolve().with_name(f"{name}-hub")
    _check_free(target, first)
    files_made, size, note = _lay_out(target, card, progress)
    row = {
        "output": str(target),
        "what": card.what,
        "files": files_made,
        "size_bytes": size,
        "license": params.license or "none chosen",
        "upload": _upload(target, card),
    }
    notes = "; ".join(filter(None, ("nothing was uploaded", card.note, note)))
    return Outcome([row], card.simulated, {"notes": notes})


def _check_free(target: Path, source: Path) -> None:
    """Raise InputError if the folder has anything in it, or is inside the folder to be shared."""
    require_possible_name(target)
    if source.is_dir() and source.resolve() in (target.resolve(), *target.resolve().parents):
        raise InputError("the output is inside the folder to be shared", where=str(target))
    require_free(target)


def _lay_out(target: Path, card: Card, progress: Progress) -> tuple[int, int, str]:
    """Write or link all files of the folder; return their number, their size in bytes, and a note."""
    with new_folder(target) as folder:
        for name, content in {**card.written, README: card.text().encode()}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        for number, (name, source) in enumerate(card.links.items()):
            progress(number, len(card.links))
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source.resolve(), folder / name)
            except OSError:  # another disk, or one without hard links
                shutil.copyfile(source, folder / name)
        note = card.more(folder, progress) if card.more is not None else ""
        sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return len(sizes), sum(sizes), note


def _upload(target: Path, card: Card) -> str:
    """Return the command of the Hub's own tool that uploads a folder; NAME is the account."""
    kind = " --repo-type dataset" if card.what == "data set" else ""
    slug = re.sub(r"[^a-z0-9]+", "-", card.title.lower()).strip("-")[:60] or "evetac"
    return f"hf upload NAME/{slug} {shlex.quote(str(target))}{kind}"
