"""Windows of features with their labels, for training your own networks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile


class SlipWindows:
    """Windows of features with their labels, as a map-style data set for torch's DataLoader.

    Item i is (window (dots, 2 * history) float32, label 0.0 or 1.0 float32). A window has for every dot its distances
    from rest in px, then its event counts, for the last `history` slices, the newest first. Left out are slices without
    a full history, slices without an examined label, and slices `after_onset` or more after the onset.

    All features are read into memory: 448 bytes per slice of 56 dots.

    >>> import torch
    >>> windows = evetac.SlipWindows(["a.features.h5"], history=10)
    >>> loader = torch.utils.data.DataLoader(windows, batch_size=16, shuffle=True)
    >>> batch, label = next(iter(loader))
    >>> batch.shape, label.shape
    (torch.Size([16, 56, 20]), torch.Size([16]))
    """

    def __init__(self, paths: Sequence[str | Path], history: int = 10, after_onset: int = 15) -> None:
        self.paths, self.history, self.after_onset = [Path(path) for path in paths], history, after_onset
        self._values: list[NDArray[np.float32]] = []  # of each file: distances and event counts, (slices, 2, dots)
        # for each window: its file, its last slice among the values of the file, its label
        index: list[NDArray[np.int32]] = [np.empty((0, 3), np.int32)]
        for number, path in enumerate(self.paths):
            with StageFile(path, "features") as file:
                index.append(self._windows_of(number, file))
        self._index = np.concatenate(index)

    def _windows_of(self, number: int, file: StageFile) -> NDArray[np.int32]:
        """Read the slices of a file that its windows need, and return its rows of the index."""
        if not file.has("label"):
            message = "the features have no labels: run evetac label, then evetac featurize"
            raise InputError(message, where=str(file.path))
        label, onset = file.read("label"), int(file.read("onset_slice"))
        stop = len(label) if onset < 0 else min(len(label), onset + self.after_onset)
        usable = np.flatnonzero(label[:stop] >= 0)
        usable = usable[usable >= self.history - 1]
        first, end = (int(usable[0]) + 1 - self.history, int(usable[-1]) + 1) if len(usable) else (0, 0)
        columns = [file.read(name, first, end) for name in ("displacement_px", "events_per_dot")]
        self._values.append(np.stack(columns, axis=1, dtype=np.float32))
        return np.stack([np.full_like(usable, number), usable - first, label[usable]], axis=1, dtype=np.int32)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], np.float32]:
        number, last, label = self._index[index].tolist()
        values = self._values[number][last + 1 - self.history : last + 1]
        # newest first; for each dot its distances, then its event counts
        return values[::-1].transpose(2, 1, 0).reshape(-1, 2 * self.history), np.float32(label)
