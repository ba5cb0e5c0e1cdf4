"""Whether outputs are up to date, answered by the indexes that lie beside files, without opening any of these.

A row is believed of a file that is as it was when it was read whole: size, time of change and inode are the same. Then
the recipe ids of the inputs are known, the stage computes that of the output from them, as it would from the files, and
compares it with the one that the index has of the output. Wherever anything is missing, or differs, files are opened.

Whose index is believed: one of this user's, of root's, or of whoever owns the folder of the file, and so could exchange
the file too. In a folder that all may write to, as /tmp, anybody could put an index above the files of others.

Why a run brings an index up to date that is there, and makes none: whoever has made one wants to be answered from it,
also of what this run made; but nobody expects a hidden file in a folder by asking for labels. It is that of the folder,
or of the nearest folder above that has one.
"""

import os
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from evetac_cli.store.index.rows import IndexRow, Seen
from evetac_cli.store.index.table import NAME, IndexTable
from evetac_cli.store.layout.provenance import Header, Recipe


class Known:
    """What indexes say of files; to be used at one time, for what is seen of a file is asked of it once."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._tables: dict[Path, IndexTable] = {}
        self._places: dict[Path, tuple[Path, str] | None] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def row(self, path: Path, *kinds: str) -> IndexRow | None:
        """The row of a file of these kinds that is as it was when it was read; None where there is none."""
        place = self.place(path.parent)
        if place is None:
            return None
        folder, inner = place
        row = self._table(folder).row(f"{inner}{path.name}")
        if row is None or row.kind not in kinds or row.recipe_id is None or row.error is not None:
            return None
        try:
            return row if row.seen == Seen.of(os.stat(path)) else None
        except OSError:
            return None

    def header(self, path: Path, *kinds: str) -> Header | None:
        """As much of the header of such a file as the recipe of what is made from it takes."""
        row = self.row(path, *kinds)
        return None if row is None else {"id": row.recipe_id, "simulated": bool(row.simulated)}

    def is_up_to_date(self, output: Path, recipe: Recipe) -> bool:
        """Whether `output` is known to hold the result of this recipe; if not, it may all the same."""
        row = self.row(output, recipe.kind)
        return row is not None and row.recipe_id == recipe.id

    def place(self, folder: Path) -> tuple[Path, str] | None:
        """The folder whose index has the files of a folder, and the way from there; None without one to believe."""
        if folder not in self._places:
            self._places[folder] = _place(folder)
        return self._places[folder]

    def unknown(self, paths: Iterable[Path]) -> dict[Path, dict[str, Seen]]:
        """Which of these files an index should have and does not, by the folder of the index: path there -> seen."""
        missing: dict[Path, dict[str, Seen]] = {}
        for path in dict.fromkeys(paths):
            place = self.place(path.parent)
            if place is None or not path.name.endswith(".h5") or path.name.startswith("."):
                continue
            folder, inner = place
            try:
                seen = Seen.of(os.stat(path))
            except OSError:
                continue
            table = self._table(folder)
            row = table.row(f"{inner}{path.name}")
            if table.is_index and (row is None or row.seen != seen):
                missing.setdefault(folder, {})[f"{inner}{path.name}"] = seen
        return missing

    def _table(self, folder: Path) -> IndexTable:
        if folder not in self._tables:
            self._tables[folder] = self._open.enter_context(IndexTable(folder / NAME))
        return self._tables[folder]


def _place(folder: Path) -> tuple[Path, str] | None:
    inner: Sequence[str] = ()
    above = folder.absolute()
    try:
        owners = {0, os.geteuid(), os.stat(above).st_uid}
    except OSError:
        return None
    while True:
        if os.path.lexists(above / NAME):
            is_theirs = os.lstat(above / NAME).st_uid in owners
            return (above, "".join(f"{name}/" for name in inner)) if is_theirs else None
        name = above.name
        if not name or name in (".", "..") or name.startswith(".") or name.endswith(".part") or above.is_symlink():
            return None  # an index has nothing of what lies there
        inner = (name, *inner)
        above = above.parent
