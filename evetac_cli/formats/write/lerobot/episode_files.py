"""Files with several consecutive episodes; a new file is begun when the current one is large enough."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

CODEC = "libx264"
CODEC_OPTIONS = {"crf": "18", "g": "2", "bf": "0"}  # every other picture is a key frame, so that seeking is fast


class EpisodePlace(NamedTuple):
    """The location of an episode: the numbers of its chunk and file, and its start time in the file, in s."""

    chunk: int
    file: int
    start_s: float = 0.0


class Numbered:
    """The names of numbered files: `pattern` with chunk_index and file_index, `chunk_files` of them per chunk.

    most_mb: size at which the next episode begins a new file; None: never.
    """

    def __init__(self, folder: Path, pattern: str, chunk_files: int, most_mb: int | None) -> None:
        self._folder, self._pattern, self._chunk_files, self._most_mb = folder, pattern, chunk_files, most_mb
        self._number = -1
        self._path: Path | None = None

    @property
    def is_over(self) -> bool:
        """Whether the next episode begins a new file."""
        if self._path is None:
            return True
        return self._most_mb is not None and self._path.stat().st_size >= self._most_mb << 20

    @property
    def place(self) -> EpisodePlace:
        """The numbers of the current file."""
        return EpisodePlace(*divmod(self._number, self._chunk_files))

    def next(self) -> str:
        """Return the path of the next file; its folder is created."""
        self._number += 1
        place = self.place
        self._path = self._folder / self._pattern.format(chunk_index=place.chunk, file_index=place.file)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        return str(self._path)


class Tables(AbstractContextManager["Tables"]):
    """Parquet files with one row group per episode; `rows` is the number of rows so far."""

    def __init__(self, arrow: Any, files: Numbered) -> None:
        self.rows = 0
        self._arrow, self._files = arrow, files
        self._writer: Any = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the current file."""
        if self._writer is not None:
            self._writer.close()

    def append(self, table: Any) -> EpisodePlace:
        """Write the rows of an episode; return its location."""
        if self._files.is_over:
            self.close()
            self._writer = self._arrow.parquet.ParquetWriter(self._files.next(), table.schema, compression="snappy")
        self._writer.write_table(table)
        self.rows += len(table)
        return self._files.place


class Videos(AbstractContextManager["Videos"]):
    """Video files of consecutive episodes; pictures are grey (height, width) or (height, width, 3)."""

    def __init__(self, av: Any, files: Numbered, fps: int, shape: Sequence[int]) -> None:
        self._av, self._files, self._fps = av, files, fps
        self._height, self._width = shape[:2]
        self._frames = 0  # in the current file
        self._file: Any = None
        self._stream: Any = None

    def __exit__(self, type_: type[BaseException] | None, *_: object) -> None:
        self.close(whole=type_ is None)

    def close(self, *, whole: bool = True) -> None:
        """Close the current file; if not `whole`, without the pictures that the codec has not written yet."""
        if self._file is None:
            return
        if whole:
            self._file.mux(self._stream.encode())
        self._file.close()

    @property
    def now_s(self) -> float:
        """The time of the next picture in the current file."""
        return self._frames / self._fps

    def begin(self) -> EpisodePlace:
        """Begin an episode; return its location."""
        if self._files.is_over:
            self.close()
            self._frames = 0
            self._file = self._av.open(self._files.next(), "w")
            self._stream = self._file.add_stream(CODEC, rate=self._fps, options=CODEC_OPTIONS)
            self._stream.width, self._stream.height, self._stream.pix_fmt = self._width, self._height, "yuv420p"
            self._file.start_encoding()  # this creates the file, whose size `is_over` reads
        return self._files.place._replace(start_s=self.now_s)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add the next picture."""
        coloured = picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)
        frame = self._av.VideoFrame.from_ndarray(coloured, format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, self._fps)
        self._file.mux(self._stream.encode(frame))
        self._frames += 1
