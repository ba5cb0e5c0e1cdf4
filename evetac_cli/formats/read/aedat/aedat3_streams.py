"""Read IMU samples and external triggers from AEDAT 3.1 files; libcaer defines their events.

type 0    special: uint32 (bit 0 valid, 1-7 kind), int32 time
type 3    IMU6: uint32 (bit 0 valid), int32 time, float32: acceleration x, y, z in g, rotation x, y, z in deg/s,
          temperature in degC; type 4, IMU9, has the magnetic field x, y, z in uT after that
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.aedat.read_aedat3 import IMU6, IMU9, NAMES, OVERFLOW_BITS, SPECIAL, packets_beside
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import Stream

AXES = [f"{part}_{axis}" for part in ("accelerometer", "gyroscope") for axis in "xyz"]
VALUES: dict[int, list[str]] = {
    SPECIAL: [],
    IMU6: [*AXES, "temperature"],
    IMU9: [*AXES, "temperature", *(f"magnetometer_{axis}" for axis in "xyz")],
}
UNITS = {"temperature": "degC", "accelerometer": "g", "gyroscope": "deg/s", "magnetometer": "uT"}
# Special events that are triggers: the input, and the number of the source in AEDAT4.
EDGES = {2: (0, 1), 3: (0, 2), 4: (0, 3), 6: (1, 1), 7: (1, 2), 8: (1, 3), 9: (2, 1), 10: (2, 2), 11: (2, 3)}
TRIGGERS = "triggers; source: external signal 1 rises, 2 falls, 3 pulses; input: number of the input"


class SampleStream(NamedTuple):
    """A stream, the name under which its samples are counted, and the number of samples that were left out."""

    stream: Stream
    counted_as: str
    left_out: int


def read_samples(path: Path, folder: Path | None) -> Iterator[SampleStream]:
    """Yield triggers and IMU samples of the camera whose events are read, on the file's clock."""
    for kind, name in ((SPECIAL, "triggers"), (IMU6, "imu"), (IMU9, "imu9")):
        reader = _SampleReader(path, kind)
        t_us, *values = joined_on_disk(folder, reader.parts()) or (np.empty(0, np.int64),)
        if len(t_us):
            names = VALUES[kind] or ["input", "source"]
            units = {one: unit for one in names for part, unit in UNITS.items() if one.startswith(part)}
            stream = Stream(name, t_us, dict(zip(names, values, strict=True)), units=units, source=path.name)
            yield SampleStream(stream, NAMES[kind], reader.count - len(t_us))


class _SampleReader:
    """The samples of one kind; `count`: the number of events of this kind."""

    def __init__(self, path: Path, kind: int) -> None:
        self._path, self._kind = path, kind
        self._layout = np.dtype([("info", "<u4"), ("t", "<i4"), *((name, "<f4") for name in VALUES[kind])])
        self.count = 0

    def parts(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield times and values of each packet's samples marked as valid; values that are not finite are NaN."""
        with self._path.open("rb") as handle:
            for packet in packets_beside(handle, str(self._path)):
                if packet.kind != self._kind:
                    continue
                self.count += packet.events
                if packet.event_bytes != self._layout.itemsize:
                    continue
                handle.seek(packet.at)
                rows = np.frombuffer(handle.read(packet.events * self._layout.itemsize), self._layout)
                rows = rows[(rows["info"] & 1) == 1]
                if self._kind == SPECIAL:
                    kinds = rows["info"] >> 1 & 0x7F
                    rows, kinds = (of[np.isin(kinds, list(EDGES))] for of in (rows, kinds))
                    values = list(np.array([EDGES[one] for one in kinds.tolist()], np.float64).reshape(-1, 2).T)
                else:
                    values = [rows[name].astype(np.float64) for name in VALUES[self._kind]]
                    values = [np.where(np.isfinite(column), column, np.nan) for column in values]
                if len(rows):
                    yield ((packet.overflows << OVERFLOW_BITS) + rows["t"].astype(np.int64), *values)
