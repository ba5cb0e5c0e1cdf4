"""Windows of features with their labels, for training your own networks."""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.sampling import PoolSizes, Size, drawn_groups
from evetac_cli.store.files import StageFile

MEMORY_GB = 3.0


class _Span(NamedTuple):
    """The slices of a file that are needed for its windows."""

    first: int
    stop: int
    dots: int

    @property
    def memory_bytes(self) -> int:
        """Memory for distances and event counts, in bytes."""
        return 4 * 2 * self.dots * (self.stop - self.first)


class SlipWindows:
    """Windows of features with their labels, as a map-style data set for torch's DataLoader.

    Item i is (window (dots, 2 * history) float32, label 0.0 or 1.0 float32). A window has for every dot its distances
    from rest in px, then its event counts, for the last `history` slices, the newest first. Left out are slices without
    a full history, slices without an examined label, and slices `after_onset` or more after the onset.

    At most `memory_gb` of features are in memory (448 bytes per slice of 56 dots). If all fit, they are read once;
    forked workers share them, spawned workers read them again. If not, a file is read when one of its windows is
    requested, which takes some 10 ms. Then use `shuffled` and not shuffle=True.

    >>> import torch
    >>> windows = evetac.SlipWindows(["a.features.h5"], history=10)
    >>> loader = torch.utils.data.DataLoader(windows, batch_size=16, sampler=windows.shuffled(seed=1))
    >>> batch, label = next(iter(loader))
    >>> batch.shape, label.shape
    (torch.Size([16, 56, 20]), torch.Size([16]))
    """

    def __init__(
        self, paths: Sequence[str | Path], history: int = 10, after_onset: int = 15, memory_gb: float = MEMORY_GB
    ) -> None:
        self.paths, self.history, self.after_onset = [Path(path) for path in paths], history, after_onset
        self.memory_gb = memory_gb
        self._cache: OrderedDict[int, NDArray[np.float32]] = OrderedDict()  # by file, the last used at the end
        self._cached_bytes = 0
        self._spans: list[_Span] = []  # one per file
        # for each window: its file, its slice there, its label
        index: list[NDArray[np.int32]] = [np.empty((0, 3), np.int32)]
        for number, path in enumerate(self.paths):
            with StageFile(path, "features") as file:
                index.append(self._windows_of(number, file))
                if self._cached_bytes + self._spans[number].memory_bytes <= self._most_bytes:
                    self._hold(number, file)
        self._index = np.concatenate(index)

    @property
    def _most_bytes(self) -> float:
        return self.memory_gb * 1e9

    def _windows_of(self, number: int, file: StageFile) -> NDArray[np.int32]:
        """Return the rows of the index for a file, and store its span."""
        if not file.has("label"):
            message = "the features have no labels: run evetac label, then evetac featurize"
            raise InputError(message, where=str(file.path))
        label, onset = file.read("label"), int(file.read("onset_slice"))
        stop = len(label) if onset < 0 else min(len(label), onset + self.after_onset)
        usable = np.flatnonzero(label[:stop] >= 0)
        usable = usable[usable >= self.history - 1]
        dots = file.contents()["displacement_px"][1][1]
        ends = (int(usable[0]) + 1 - self.history, int(usable[-1]) + 1) if len(usable) else (0, 0)
        self._spans.append(_Span(*ends, dots))
        return np.stack([np.full_like(usable, number), usable, label[usable]], axis=1, dtype=np.int32)

    def _hold(self, number: int, file: StageFile) -> NDArray[np.float32]:
        """Read distances and event counts of a file, (slices, 2, dots), and drop files that were used longest ago."""
        first, stop, _ = span = self._spans[number]
        while self._cache and self._cached_bytes + span.memory_bytes > self._most_bytes:
            other, _ = self._cache.popitem(last=False)
            self._cached_bytes -= self._spans[other].memory_bytes
        columns = [file.read(name, first, stop) for name in ("displacement_px", "events_per_dot")]
        self._cache[number] = values = np.stack(columns, axis=1, dtype=np.float32)
        self._cached_bytes += span.memory_bytes
        return values

    def _values(self, number: int) -> NDArray[np.float32]:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        with StageFile(self.paths[number], "features") as file:
            return self._hold(number, file)

    def shuffled(self, seed: int = 0) -> "WindowOrder":
        """Return a sampler for torch's DataLoader: every window once, in a new random order in each epoch.

        If not all files fit in memory, they are drawn at random in groups that fit, and windows at random within each
        group. A file is then read once per epoch.
        """
        return WindowOrder(self, np.random.default_rng(seed))

    def _in_order(self, rng: np.random.Generator) -> Iterator[int]:
        sizes = [Size(span.memory_bytes, PoolSizes(1, 1, 0)) for span in self._spans]
        edges = np.searchsorted(self._index[:, 0], np.arange(len(self.paths) + 1))
        for group in drawn_groups(sizes, int(self._most_bytes), rng):
            windows = np.concatenate([np.arange(edges[number], edges[number + 1]) for number in group])
            yield from rng.permutation(windows).tolist()

    def __reduce__(self) -> tuple[Any, ...]:
        """Support for spawned workers, which open the files themselves."""
        return SlipWindows, (self.paths, self.history, self.after_onset, self.memory_gb)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], np.float32]:
        number, slice_, label = self._index[index].tolist()
        begin = slice_ + 1 - self.history - self._spans[number].first
        values = self._values(number)[begin : begin + self.history]
        # newest first; for each dot its distances, then its event counts
        return values[::-1].transpose(2, 1, 0).reshape(-1, 2 * self.history), np.float32(label)


class WindowOrder:
    """The indices of all windows, in a new random order at each iteration."""

    def __init__(self, windows: SlipWindows, rng: np.random.Generator) -> None:
        self._windows, self._rng = windows, rng

    def __len__(self) -> int:
        return len(self._windows)

    def __iter__(self) -> Iterator[int]:
        return self._windows._in_order(self._rng)
