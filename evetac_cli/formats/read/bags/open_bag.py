"""Open ROS 1 bags (`.bag`) and ROS 2 bags (a folder, `.db3`, `.mcap`): connections and messages of all their files.

Formats are recognized by the content of the files, not by their names or the folder's metadata. The readers are
rosbag1_records, mcap_records and db3_rows. rosbags, of the extra `convert`, provides the types that ROS itself defines
and the modules that unpack chunks.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from evetac_cli.errors import EvetacError, InputError, missing_extra
from evetac_cli.formats.read.bags import bag_files
from evetac_cli.formats.read.bags.bag_chunks import Connection
from evetac_cli.formats.read.bags.rosbag_unpacking import unpack_message, zstd_module

LIBRARIES = ("rosbags.typesys", "mcap.records", "lz4.frame", "ruamel.yaml")
Message = tuple[Connection, int, bytes]  # and the time of its reception in ns


class Bag:
    """All files of a bag: its connections, its messages, and notes on files next to it and on missing data.

    notes: after `messages` also on data that could not be read. cut_short: whether messages are known to be missing.
    """

    def __init__(self, path: Path) -> None:
        """Read the tables of all files; raise InputError if files are missing or have no readable message."""
        self.path = path
        files = bag_files.files_of(path)
        self._files = files.paths
        self.notes, self.cut_short = list(files.notes), False
        counts: Counter[Connection] = Counter()
        for file in self._files:
            table, joined, cut = bag_files.opened(file, self._where(file))
            of = f"{file.name}: " if path.is_dir() and len(self._files) > 1 else ""
            self.notes += [of + note for note in (*joined, *table.table.notes)]
            self.cut_short |= cut or table.table.cut_short
            for one in table.connections:
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

    def _where(self, file: Path) -> str:
        return str(file) if file == self.path else f"{self.path}: {file.name}"

    def disordered(self, connections: Collection[Connection]) -> bool:
        """Whether the messages of some connections may be stored in another order than they were received."""
        wanted = {_alike(one) for one in connections}
        latest_ns = -math.inf
        for file in self._files:
            table = bag_files.opened(file, self._where(file))[0]
            numbers = {one.number for one in table.connections if _alike(one) in wanted and one.msgcount}
            if len(numbers) > 1 or numbers & table.table.disordered:
                return True
            for first_ns, last_ns in (table.table.spans_ns[number] for number in numbers):
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
        lost: Counter[str] = Counter()
        for file in self._files:
            with bag_in_words(str(self.path), "a message"):
                table, _, _ = bag_files.opened(file, self._where(file))
                numbers = {one.number: wanted[_alike(one)] for one in table.connections if _alike(one) in wanted}
                for number, time_ns, message in table.messages(numbers, lost, by_reception=by_reception):
                    connection = numbers[number]
                    packed = connection.ros2 and message[: len(bag_files.ZSTD)] == bag_files.ZSTD
                    yield connection, time_ns, unpack_message(bytes(message)) if packed else bytes(message)
        if lost:
            self.cut_short = True
            reason, count = next(iter(lost)), lost.total()
            note = f"left out {count:,} damaged chunks or messages ({reason})"
            self.notes += [note] if note not in self.notes else []


def _alike(connection: Connection) -> Connection:
    """Return a connection reduced to the fields that are the same in all files of a bag."""
    return connection._replace(number=0, msgcount=0)


def open_bag(path: Path) -> Bag:
    """Open a bag and read the tables of its files; raise InputError or MissingLibrary if that is not possible."""
    where = str(path)
    try:
        missing = [name for name in LIBRARIES if find_spec(name) is None]
        zstd_module()
    except ImportError as error:
        missing = [error.name or str(error)]
    if missing:
        raise missing_extra("ROS bags need rosbags and mcap", "convert", where=where, found=f"no {missing[0]}")
    with bag_in_words(where, "the bag"):
        return Bag(path)


@contextmanager
def bag_in_words(where: str, what: str) -> Iterator[None]:
    """Turn any exception into InputError, because libraries and parsers raise all kinds for damaged bags."""
    try:
        yield
    except (MemoryError, OSError, EvetacError):
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(f"{what} cannot be read", where=where, found=reason) from None
