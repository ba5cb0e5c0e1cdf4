"""Determine from the indexes next to files whether outputs are up to date, without opening the files.

A row of the index is trusted if its file is unchanged since it was read completely: size, time of change and inode are
the same. The recipe ids of the inputs are then known. The stage computes the id of the output from them, as it would
from the files, and compares it with the id in the index. If anything is missing or differs, the files are opened.

An index is trusted if it belongs to this user, to root, or to the owner of the file's folder, who could replace the
file as well. In a folder that everyone can write to, such as /tmp, any user could put an index above others' files.

A run updates an existing index but does not create one. A user who created an index wants answers from it, also about
the files of this run; but a user who runs `label` does not expect a hidden file in the folder. The index is that of the
folder, or of the nearest parent that has one.
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
    """Access to the indexes of files, for short use: the location of each index is determined only once."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._tables: dict[Path, IndexTable] = {}
        self._places: dict[Path, tuple[Path, str] | None] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def row(self, path: Path, *kinds: str) -> IndexRow | None:
        """Return the row of a file of these kinds that is unchanged since it was read; None if there is none."""
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
        """Return the part of such a file's header that is needed for the recipe of a file made from it."""
        row = self.row(path, *kinds)
        return None if row is None else {"id": row.recipe_id, "simulated": bool(row.simulated), "seed": row.seed}

    def is_up_to_date(self, output: Path, recipe: Recipe) -> bool:
        """Whether `output` is known to have the result of this recipe; if False, it may still have it."""
        row = self.row(output, recipe.kind)
        return row is not None and row.recipe_id == recipe.id

    def place(self, folder: Path) -> tuple[Path, str] | None:
        """Return the folder whose index covers a folder, and the path from there; None without a trusted index."""
        if folder not in self._places:
            self._places[folder] = _place(folder)
        return self._places[folder]

    def unknown(self, paths: Iterable[Path]) -> dict[Path, dict[str, Seen]]:
        """Return the files that are missing in their index or outdated: folder of the index -> path there -> status."""
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
            return None  # an index does not cover such folders
        inner = (name, *inner)
        above = above.parent
