"""Open ROS 1 bags (`.bag`) and ROS 2 bags (a folder, `.db3`, `.mcap`): connections and messages of all their files.

Formats are recognized by the content of the files, not by their names or the folder's metadata. rosbags, of the extra
`convert`, also provides the types that ROS itself defines.
"""

import heapq
import math
from collections import Counter
from collections.abc import Collection, Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from evetac_cli.errors import missing_extra
from evetac_cli.formats.read.bags import bag_files
from evetac_cli.formats.read.bags.bag_readers import Connection
from evetac_cli.formats.read.damage import read_in_words, unpacked

LIBRARIES = ("rosbags.typesys", "mcap.records", "lz4.frame", "zstandard", "ruamel.yaml")
MOST_HELD_BYTES = 256 << 20  # of messages that wait for others received earlier
Message = tuple[Connection, int, bytes]  # and the time of its reception in ns


class Bag:
    """All files of a bag: its connections, its messages, and notes on files next to it and on missing data.

    cut_short: whether messages are known to be missing.
    """

    def __init__(self, path: Path, files: bag_files.Files) -> None:
        """Read the tables of all files; raise InputError if files are missing or have no readable message."""
        self.path = path
        self.notes, self.cut_short = list(files.notes), False
        self._files = []
        counts: Counter[Connection] = Counter()
        for file in files.paths:
            opened = bag_files.opened(file, str(file) if file == path else f"{path}: {file.name}")
            self._files.append(opened)
            of = f"{file.name}: " if path.is_dir() and len(files.paths) > 1 else ""
            self.notes += [of + note for note in opened.notes]
            self.cut_short |= opened.cut_short
            for one in opened.connections:
                counts[_alike(one)] += one.msgcount
        self.connections = [
            one._replace(number=number, msgcount=count) for number, (one, count) in enumerate(counts.items())
        ]
        message_count = counts.total()
        if files.stated is not None and files.stated != message_count:
            self.notes.append(
                f"{bag_files.METADATA} states {files.stated:,} messages, but the bag has {message_count:,}"
            )
            self.cut_short |= files.stated > message_count

    def disordered(self, connections: Collection[Connection]) -> bool:
        """Whether the messages of some connections may be stored in another order than they were received."""
        wanted = {_alike(one) for one in connections}
        latest_ns = -math.inf
        for file in self._files:
            numbers = {one.number for one in file.connections if _alike(one) in wanted and one.msgcount}
            if len(numbers) > 1 or numbers & file.disordered:
                return True
            for first_ns, last_ns in (file.spans_ns[number] for number in numbers):
                if first_ns < latest_ns:
                    return True
                latest_ns = last_ns
        return False

    def messages(self, connections: Collection[Connection], *, by_reception: bool = False) -> Iterator[Message]:
        """Yield all messages of some connections, file after file, in each file's order; InputError if damaged.

        by_reception: in the order of reception within each file instead. It hangs on the recorder's clock, which may be
        set back at any time.
        """
        wanted = {_alike(one): one for one in connections}
        for file in self._files:
            with read_in_words(str(self.path), "a message cannot be read"):
                numbers = {one.number: wanted[_alike(one)] for one in file.connections if _alike(one) in wanted}
                records = file.messages(numbers)
                for number, time_ns, message in _by_reception(records) if by_reception else records:
                    connection = numbers[number]
                    if connection.ros2 and message.startswith(bag_files.ZSTD):
                        message = unpacked(bag_files.zstd_module().ZstdDecompressor, message, str(self.path))  # noqa: PLW2901
                    yield connection, time_ns, message


def _by_reception(records: Iterator[Any]) -> Iterator[Any]:
    """Yield records in order of their time, as far as those that wait for others fit in memory."""
    waiting: list[tuple[int, int, Any]] = []
    held_bytes = 0
    for place, record in enumerate(records):
        heapq.heappush(waiting, (record[1], place, record))
        held_bytes += len(record[2])
        while held_bytes > MOST_HELD_BYTES:
            *_, first = heapq.heappop(waiting)
            held_bytes -= len(first[2])
            yield first
    while waiting:
        yield heapq.heappop(waiting)[2]


def _alike(connection: Connection) -> Connection:
    """Return a connection reduced to the fields that are the same in all files of a bag."""
    return connection._replace(number=0, msgcount=0)


def open_bag(path: Path) -> Bag:
    """Open a bag and read the tables of its files; raise InputError or MissingLibrary if that is not possible."""
    where = str(path)
    try:
        missing = [name for name in LIBRARIES if find_spec(name) is None]
        bag_files.zstd_module()
    except ImportError as error:
        missing = [error.name or str(error)]
    if missing:
        raise missing_extra("ROS bags need rosbags and mcap", "convert", where=where, found=f"no {missing[0]}")
    with read_in_words(where, "the bag cannot be read"):
        files = bag_files.files_of(path)
        return _bag(path, files, tuple(stamp for file in files.paths for stamp in bag_files.stamps(file)))


@lru_cache(maxsize=2)
def _bag(path: Path, files: bag_files.Files, stamps: tuple[Any, ...]) -> Bag:
    """Return a bag, cached as long as its files do not change."""
    del stamps
    return Bag(path, files)
