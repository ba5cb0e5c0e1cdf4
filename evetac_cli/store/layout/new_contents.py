"""Checks the contents of a file that is being written, with the same rules as `contents` for files that are read.

Invalid contents are refused before the file is complete, and not by a later reader. Values are checked while they are
still in memory, which costs a fraction of reading back what was just compressed. Only indices of rows of another
dataset, whose length is known at the end, are read again; there are few of them.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evetac_cli.errors import SchemaError
from evetac_cli.store.layout import contents, schema
from evetac_cli.store.layout.rules import Shapes

HINT = "the file was not written; check its inputs with `evetac validate`"


class NewContents:
    """Datasets of a new file: some in memory as a whole, others passed block by block while they are written.

    It has the interface of an open file for the checks of `contents`, which raise SchemaError with the new file's path.
    """

    def __init__(self, path: Path, kind: str, whole: Mapping[str, Any]) -> None:
        """whole: the datasets in memory. `shapes` of the others are known once all of their blocks were passed."""
        self.path, self.kind = path, kind
        self.shapes: Shapes = {name: schema.describe(value) for name, value in whole.items()}
        self._whole = dict(whole)
        self._last: dict[str, Any] = {}  # last value of each dataset so far
        self._indices: set[str] = set()  # datasets in blocks that are checked at the end
        self._h5: h5py.File | None = None

    def add(self, whole: Mapping[str, Any]) -> None:
        """Add more datasets in memory."""
        self.shapes |= {name: schema.describe(value) for name, value in whole.items()}
        self._whole |= whole

    def check_block(self, name: str, rows: Any, first: int) -> None:
        """Check the rows of a dataset, starting at row `first`, against its limits."""
        described = schema.load(self.kind).find(name)
        if described is not None and described.limits.index_of:
            self._indices.add(name)
            return
        with _not_written():
            contents.check_values(self, name, rows, first)
            self._last[name] = contents.check_order(self, name, self._last.get(name), rows)

    def check_rest(self, h5: h5py.File | None = None) -> None:
        """Check the datasets without blocks, and the rules across datasets; `h5` contains the blocks, if any."""
        self._h5 = h5
        with _not_written():
            contents.check_shapes(self.kind, self.path, self.shapes)
            for name, (_, shape) in self.shapes.items():
                if name in self._whole or name in self._indices:
                    contents.check_dataset(self, name, shape)
            contents.check_small(self, self.shapes)

    def read(self, path: str, start: int = 0, stop: int | None = None) -> Any:
        """Return a dataset, or its rows [start, stop); SchemaError if values violate the schema."""
        values = self._whole[path] if path in self._whole else self._written(path)
        if not isinstance(values, str):
            values = values[start:stop] if np.ndim(values) else np.asarray(values)[()]
        contents.check_values(self, path, values, start)
        return values

    def has(self, path: str) -> bool:
        """Whether there is such a dataset."""
        return path in self.shapes

    def contents(self) -> Shapes:
        """Path -> (dtype, shape)."""
        return self.shapes

    def length(self, path: str) -> int:
        """Rows of a dataset."""
        return int(self.shapes[path][1][0])

    def _written(self, path: str) -> Any:
        if self._h5 is None or path not in self._h5:
            schema.refuse(self.kind, [f"{path} is missing"], str(self.path))
        return self._h5[path]  # type: ignore[index]


@contextmanager
def _not_written() -> Iterator[None]:
    """Add to a SchemaError the hint that the file was not written."""
    try:
        yield
    except SchemaError as error:
        error.hint = HINT
        raise
