"""Read other programs' event files with evetac and with an independent reader: are all events equal?

    python scripts/speed/compare_readers.py FILE_OR_FOLDER ... [--json]

The table has a row for each file and independent reader (judge): the columns compared, the number of events, and how
many differ. Judges are libraries, if they are installed, and numpy for layouts that take a few lines to read. A known
difference of a judge is in its row of JUDGES. Exit code 1 if anything differs. docs/recordings.md has a table of real
files.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.imports import Imported, read_events

Read = Callable[[Path, Imported], dict[str, Any]]


def expelliarmus(encoding: str) -> Read:
    def read(path: Path, _: Imported) -> dict[str, Any]:
        from expelliarmus import Wizard

        return columns_of(Wizard(encoding=encoding).read(path))

    return read


def columns_of(rows: Any, polarity: str = "p") -> dict[str, Any]:
    if rows is None:
        raise LookupError("the reader refuses the file")
    return {name: rows[polarity if name == "p" else name] for name in "txyp"}


def faery(path: Path, imported: Imported) -> dict[str, Any]:
    import faery

    stream = faery.events_stream_from_file(path, dimensions_fallback=imported.frame_px)
    return columns_of(np.concatenate(list(stream)), "on")


def dv_processing(path: Path, _: Imported) -> dict[str, Any]:
    import dv_processing as dv

    recording = dv.io.MonoCameraRecording(str(path))
    parts = []
    while (events := recording.getNextEventBatch()) is not None:
        parts.append(events.numpy())
    rows = np.concatenate(parts)
    return {"t": rows["timestamp"], "x": rows["x"], "y": rows["y"], "p": rows["polarity"]}


def aedat(path: Path, _: Imported) -> dict[str, Any]:
    import aedat

    packets = [packet["events"] for packet in aedat.Decoder(path) if "events" in packet]
    return columns_of(np.concatenate(packets), "on")


def dat_words(path: Path, _: Imported) -> dict[str, Any]:
    """Read version 2 as Prophesee's toolbox does: lines that begin with %, two bytes, then time and position."""
    content = path.read_bytes()
    at = 0
    while content[at : at + 1] == b"%":
        at = content.index(b"\n", at) + 1
    words = np.frombuffer(content[at + 2 :], "<u4").reshape(-1, 2).astype(np.int64)
    place = words[:, 1]
    return {"t": words[:, 0], "x": place & 0x3FFF, "y": place >> 14 & 0x3FFF, "p": place >> 28 & 1}


def aedat2_words(path: Path, imported: Imported) -> dict[str, Any]:
    """Read a DAVIS file as jAER writes it: lines that begin with #, then address and time, big-endian."""
    content = path.read_bytes()
    at = 0
    while content[at : at + 1] == b"#":
        at = content.index(b"\n", at) + 1
    content = content[at:]
    words = np.frombuffer(content[: len(content) // 8 * 8], ">u4").reshape(-1, 2).astype(np.int64)
    words = words[(words[:, 0] >> 31 == 0) & (words[:, 0] >> 10 & 1 == 0)]
    place, (width, height) = words[:, 0], imported.frame_px
    return {
        "t": words[:, 1],
        "x": width - 1 - (place >> 12 & 0x3FF),
        "y": height - 1 - (place >> 22 & 0x1FF),
        "p": place >> 11 & 1,
    }


def evt3_words(path: Path, _: Imported) -> dict[str, Any]:
    """Read EVT3 word by word, per Prophesee's page; each fall of the time-high bits from last to first is a wrap."""
    content = path.read_bytes()
    at = 0
    while content[at : at + 2] == b"% ":
        at = content.index(b"\n", at) + 1
    high, low, row, column, vector_p, turns = -1, 0, 0, 0, 0, 0
    events = []
    for word in np.frombuffer(content[at : at + (len(content) - at) // 2 * 2], "<u2").tolist():
        kind, value = word >> 12, word & 0xFFF
        if kind == 8:
            turns += high == 0xFFF and value == 0
            low = low if value == high else 0
            high = value
        elif high < 0:
            continue
        elif kind == 6:
            low = value
        elif kind == 0:
            row = value & 0x7FF
        elif kind == 2:
            events.append((turns << 24 | high << 12 | low, value & 0x7FF, row, value >> 11))
        elif kind == 3:
            column, vector_p = value & 0x7FF, value >> 11
        elif kind in (4, 5):
            bits = 12 if kind == 4 else 8
            events += [
                (turns << 24 | high << 12 | low, column + bit, row, vector_p) for bit in range(bits) if value >> bit & 1
            ]
            column += bits
    return dict(zip("txyp", np.array(events).T, strict=True))


def packets_of(path: Path, store: Any) -> Iterator[Any]:
    """Return the EventPacket messages of a bag. MCAP is read by mcap, as rosbags needs metadata that name a storage."""
    kind = "event_camera_msgs/msg/EventPacket"
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path] if path.suffix == ".mcap" else []
    if files:
        from mcap.reader import make_reader

        for file in files:
            with file.open("rb") as opened:
                for schema, _, message in make_reader(opened).iter_messages():
                    if schema is not None and schema.name == kind:
                        yield store.deserialize_cdr(message.data, kind)
        return
    from rosbags.highlevel import AnyReader

    with AnyReader([path], default_typestore=store) as reader:
        chosen = [one for one in reader.connections if one.msgtype == kind]
        for connection, _, message in reader.messages(chosen):
            yield reader.deserialize(message, connection.msgtype)


def libcaer_words(content: Any, base_us: int) -> list[tuple[int, ...]]:
    """Return the events (t, x, y, p) of a libcaer_driver packet; a 16-bit word's four high bits are its kind."""
    high = low = column = row = polarity = 0
    events = []
    for word in content.view("<u2").tolist():
        kind, value = word >> 12, word & 0xFFF
        if kind == 0:
            high = value
        elif kind == 1:
            low = value
        elif kind == 2:
            column = value & 0x7FF
        elif kind == 3:
            events.append((base_us + (high << 12 | low), column, value & 0x7FF, value >> 11))
        elif kind == 4:
            row, polarity = value & 0x7FF, value >> 11
        elif kind == 5:
            t = base_us + (high << 12 | low)
            events += [(t, column, row + bit, polarity) for bit in range(8) if value >> bit & 1]
    return events


def bag_packets(path: Path, _: Imported) -> dict[str, Any]:
    """Return the words of all packets except triggers, found by rosbags or mcap, as one RAW file for expelliarmus."""
    import tempfile

    from expelliarmus import Wizard
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    text = (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events\n"
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(text, "event_camera_msgs/msg/EventPacket"))
    content = b""
    compressed: list[tuple[int, ...]] = []
    for packet in packets_of(path, store):
        if packet.encoding == "libcaer_cmp":
            compressed += libcaer_words(np.asarray(packet.events), packet.time_base // 1000)
        elif packet.encoding == "evt3":
            content += bytes(packet.events)
        else:
            raise LookupError(f"packets in {packet.encoding}")
    if compressed:
        return dict(zip("txyp", np.array(compressed).T, strict=True))
    words = np.frombuffer(content, "<u2")
    words = words[words >> 12 != 0xA]  # triggers, which expelliarmus refuses
    with tempfile.NamedTemporaryFile(suffix=".raw") as file:
        file.write(b"% evt 3.0\n% geometry 640x480\n" + words.tobytes())
        file.flush()
        return columns_of(Wizard(encoding="evt3").read(Path(file.name)))


class Judge(NamedTuple):
    """A reader, the columns it can check, and the number of ticks after which its times wrap (0: never)."""

    name: str
    read: Read
    span_us: int = 0


JUDGES: dict[str, tuple[Judge, ...]] = {
    "EVT2": (Judge("expelliarmus", expelliarmus("evt2")), Judge("faery", faery)),
    # It counts the high bits of time twice; the low twelve are right.
    "EVT3": (
        Judge("expelliarmus", expelliarmus("evt3"), 1 << 12),
        Judge("Python, by the maker's page", evt3_words),
    ),
    "DAT": (Judge("expelliarmus", expelliarmus("dat")), Judge("numpy, by the maker's toolbox", dat_words)),
    "AEDAT4": (Judge("dv-processing", dv_processing), Judge("aedat", aedat), Judge("faery", faery)),
    "AEDAT 2": (Judge("numpy, by jAER's layout", aedat2_words),),
    "bag": (Judge("rosbags or mcap, and expelliarmus or Python", bag_packets, 1 << 12),),
}


def kind_of(path: Path) -> str:
    """Return the row of JUDGES for a file, by its first bytes; empty if there is none."""
    if path.is_dir() or path.suffix in (".bag", ".db3", ".mcap"):
        return "bag"
    head = path.read_bytes()[:4096]
    if head.startswith(b"#!AER-DAT4"):
        return "AEDAT4"
    if head.startswith(b"#!AER-DAT2"):
        return "AEDAT 2"
    if not head.startswith(b"%"):
        return ""
    text = head.lower()
    return "EVT3" if b"evt3" in text or b"evt 3" in text else "EVT2" if b"evt" in text else "DAT"


def rows(path: Path) -> Iterator[dict[str, Any]]:
    kind = kind_of(path)
    if not kind:
        return
    try:
        imported = read_events(path)
    except InputError as error:
        yield {"file": path.name, "format": kind, "judge": "", "events": None, "differ": None, "note": str(error)}
        return
    for judge in JUDGES[kind]:
        row: dict[str, Any] = {"file": path.name, "format": kind, "judge": judge.name, "events": imported.events.size}
        try:
            theirs = judge.read(path, imported)
        except Exception as error:  # any exception that a library raises for a file that it refuses
            yield row | {"differ": None, "note": f"not judged: {error}"}
            continue
        yield row | compared(imported, theirs, judge.span_us)


def compared(imported: Imported, theirs: dict[str, Any], span_us: int) -> dict[str, Any]:
    events = imported.events
    if len(theirs["t"]) != events.size:
        return {"differ": abs(len(theirs["t"]) - events.size), "note": f"the judge has {len(theirs['t']):,} events"}
    ours = {"t": events.t + imported.t_offset_us, "x": events.x, "y": events.y, "p": events.p}
    differ = np.zeros(events.size, bool)
    for name in "txyp":
        mine, other = ours[name].astype(np.int64), np.asarray(theirs[name]).astype(np.int64)
        if name == "p":
            other = (other > 0).astype(np.int64)
        differ |= (mine - other) % span_us != 0 if name == "t" and span_us else mine != other
    return {"differ": int(np.count_nonzero(differ)), "note": f"t modulo {span_us:,} us" if span_us else ""}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    files = []
    for one in given.files:
        bag = one.is_dir() and (one / "metadata.yaml").is_file()
        files += [one] if bag or not one.is_dir() else sorted(one.iterdir())
    table = [row for path in files if path.is_file() or (path / "metadata.yaml").is_file() for row in rows(path)]
    if given.json:
        print(json.dumps(table, indent=1))
    else:
        print("| file | format | judge | events | differ | |\n| --- | --- | --- | --- | --- | --- |")
        for row in table:
            print("|", " | ".join("" if value is None else f"{value}" for value in row.values()), "|")
    sys.exit(any(row["differ"] for row in table))


if __name__ == "__main__":
    main()
