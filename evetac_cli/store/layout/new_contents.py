"""The contents of a file that is being written, held to what `contents` asks of one that is read.

Why so: what makes no sense is refused before the file takes its place, and not by whoever reads it later. Values are
looked at while they are still in memory, which costs a fraction of reading back what was just compressed. Only indices
of rows of another dataset, whose length is known at the end, are read again: there are few of them.
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

HINT = "the file was not written; see what `evetac validate` says of its inputs"


class NewContents:
    """Datasets of a new file: some in memory as a whole, others given block by block on their way into the file.

    To the checks of `contents` it looks like an open file. What they refuse is a SchemaError that names the file to be.
    """

    def __init__(self, path: Path, kind: str, whole: Mapping[str, Any]) -> None:
        """`whole`: the datasets in memory; `shapes` of the others are known once all of their blocks have come."""
        self.path, self.kind = path, kind
        self.shapes: Shapes = {name: schema.describe(value) for name, value in whole.items()}
        self._whole = dict(whole)
        self._last: dict[str, Any] = {}  # value of a dataset that its next block follows
        self._indices: set[str] = set()  # datasets of blocks that are checked at the end
        self._h5: h5py.File | None = None

    def add(self, whole: Mapping[str, Any]) -> None:
        """More datasets in memory, that were not known before."""
        self.shapes |= {name: schema.describe(value) for name, value in whole.items()}
        self._whole |= whole

    def check_block(self, name: str, rows: Any, first: int) -> None:
        """Hold the rows of a dataset from row `first` on to its limits."""
        described = schema.load(self.kind).find(name)
        if described is not None and described.limits.index_of:
            self._indices.add(name)
            return
        with _not_written():
            contents.check_values(self, name, rows, first)
            self._last[name] = contents.check_order(self, name, self._last.get(name), rows)

    def check_rest(self, h5: h5py.File | None = None) -> None:
        """Check what came in no block, and how the datasets fit each other; `h5` holds the blocks, if any came."""
        self._h5 = h5
        with _not_written():
            contents.check_shapes(self.kind, self.path, self.shapes)
            for name, (_, shape) in self.shapes.items():
                if name in self._whole or name in self._indices:
                    contents.check_dataset(self, name, shape)
            contents.check_small(self, self.shapes)

    def read(self, path: str, start: int = 0, stop: int | None = None) -> Any:
        """A dataset, or its rows [start, stop); SchemaError where values are not what the schema allows."""
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
    """Let an error say that there is no file, and where to look."""
    try:
        yield
    except SchemaError as error:
        error.hint = HINT
        raise
