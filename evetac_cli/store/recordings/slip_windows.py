"""Windows of features with their labels, for training networks of one's own."""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.sample_groups import Size, drawn_groups
from evetac_cli.kernels.slip.sampling import PoolSizes
from evetac_cli.store.files import StageFile

MEMORY_GB = 3.0


class _Span(NamedTuple):
    """The slices of a file that its windows need."""

    first: int
    stop: int
    dots: int

    @property
    def memory_bytes(self) -> int:
        """Of distances and event counts."""
        return 4 * 2 * self.dots * (self.stop - self.first)


class SlipWindows:
    """Windows of features with their labels: a map-style data set that torch's DataLoader takes as it is.

    Item i is (window (dots, 2 * history) float32, label 0.0 or 1.0 float32); a window holds for every dot its distances
    from rest in px, then its event counts, of the last `history` slices, the newest first. Slices without a full
    history, without an examined label, or `after_onset` slices and more after the onset are left out.

    At most `memory_gb` of features are in memory (448 bytes a slice of 56 dots). If all fit, they are read once, and
    workers that are forked share them; those that are spawned read them again. If not, files are read when a window of
    them is asked for, which takes some 10 ms each: draw with `shuffled` then, not with shuffle=True.

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
        self._held: OrderedDict[int, NDArray[np.float32]] = OrderedDict()  # by file, the one used last at the end
        self._held_bytes = 0
        self._spans: list[_Span] = []  # of each file
        # of each window: its file, its slice there, its label
        index: list[NDArray[np.int32]] = [np.empty((0, 3), np.int32)]
        for number, path in enumerate(self.paths):
            with StageFile(path, "features") as file:
                index.append(self._windows_of(number, file))
                if self._held_bytes + self._spans[number].memory_bytes <= self._most_bytes:
                    self._hold(number, file)
        self._index = np.concatenate(index)

    @property
    def _most_bytes(self) -> float:
        return self.memory_gb * 1e9

    def _windows_of(self, number: int, file: StageFile) -> NDArray[np.int32]:
        """Rows of the index for a file, whose span is noted."""
        if not file.has("label"):
            raise InputError("these features have no labels", where=str(file.path), hint="evetac label, then featurize")
        label, onset = file.read("label"), int(file.read("onset_slice"))
        stop = len(label) if onset < 0 else min(len(label), onset + self.after_onset)
        usable = np.flatnonzero(label[:stop] >= 0)
        usable = usable[usable >= self.history - 1]
        dots = file.contents()["displacement_px"][1][1]
        ends = (int(usable[0]) + 1 - self.history, int(usable[-1]) + 1) if len(usable) else (0, 0)
        self._spans.append(_Span(*ends, dots))
        return np.stack([np.full_like(usable, number), usable, label[usable]], axis=1, dtype=np.int32)

    def _hold(self, number: int, file: StageFile) -> NDArray[np.float32]:
        """Distances and event counts of a file, (slices, 2, dots), for which files that were used longer ago go."""
        first, stop, _ = span = self._spans[number]
        while self._held and self._held_bytes + span.memory_bytes > self._most_bytes:
            other, _ = self._held.popitem(last=False)
            self._held_bytes -= self._spans[other].memory_bytes
        columns = [file.read(name, first, stop) for name in ("displacement_px", "events_per_dot")]
        self._held[number] = values = np.stack(columns, axis=1, dtype=np.float32)
        self._held_bytes += span.memory_bytes
        return values

    def _values(self, number: int) -> NDArray[np.float32]:
        if number in self._held:
            self._held.move_to_end(number)
            return self._held[number]
        with StageFile(self.paths[number], "features") as file:
            return self._hold(number, file)

    def shuffled(self, seed: int = 0) -> "WindowOrder":
        """Every window once, at random, another time in another order: a sampler for torch's DataLoader.

        Where not all fit into memory, files are drawn at random in groups that do, and windows at random within each
        group: a file is then read once an epoch.
        """
        return WindowOrder(self, np.random.default_rng(seed))

    def _in_order(self, rng: np.random.Generator) -> Iterator[int]:
        sizes = [Size(span.memory_bytes, PoolSizes(1, 1, 0)) for span in self._spans]
        edges = np.searchsorted(self._index[:, 0], np.arange(len(self.paths) + 1))
        for group in drawn_groups(sizes, int(self._most_bytes), rng):
            windows = np.concatenate([np.arange(edges[number], edges[number + 1]) for number in group])
            yield from rng.permutation(windows).tolist()

    def __reduce__(self) -> tuple[Any, ...]:
        """For workers that are spawned, which have files of their own."""
        return SlipWindows, (self.paths, self.history, self.after_onset, self.memory_gb)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], np.float32]:
        number, slice_, label = self._index[index].tolist()
        begin = slice_ + 1 - self.history - self._spans[number].first
        values = self._values(number)[begin : begin + self.history]
        # newest first; of each dot its distances, then its event counts
        return values[::-1].transpose(2, 1, 0).reshape(-1, 2 * self.history), np.float32(label)


class WindowOrder:
    """The numbers of all windows at random, in an order of its own each time that they are gone through."""

    def __init__(self, windows: SlipWindows, rng: np.random.Generator) -> None:
        self._windows, self._rng = windows, rng

    def __len__(self) -> int:
        return len(self._windows)

    def __iter__(self) -> Iterator[int]:
        return self._windows._in_order(self._rng)
