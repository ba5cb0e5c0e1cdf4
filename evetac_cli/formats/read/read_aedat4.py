"""Read events from AEDAT4 files (iniVation): the intact packets of one event stream."""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.note import read_note
from evetac_cli.formats.read.aedat4_packets import (
    KINDS,
    Header,
    Packets,
    PacketStream,
    check_libraries,
    decoded,
    read_header,
    walk,
)
from evetac_cli.formats.read.source import NOT_RECORDED, EventColumns, EventSource, ImportFormat, at_index, choose_frame

BATCH_EVENTS = 1 << 18  # a packet has some thousand events


def open_aedat4(path: Path, frame_px: tuple[int, int] | None, stream: str | None = None) -> EventSource:
    """Return the events of the named stream, or the first by name; frame_px is only for files that do not state it."""
    where = str(path)
    with path.open("rb") as handle:
        header = read_header(handle, where)
        label, event_stream, others = _choose(handle, header, stream, where)
        packets = walk(handle, header, event_stream.number)
        left_out = _left_out(header, packets, others)
    source = EventSource("aedat4", choose_frame(event_stream.frame_px, frame_px, where), ())
    source.note = read_note(event_stream.note, where) if event_stream.note else None
    if others:
        also = ", ".join(others)
        source.notes.append(f"read the event stream {label}; the file also has: {also} (choose with --stream)")
    source.left_out |= left_out
    source.may_be_empty = packets.whole and header.table >= 0 and not packets.spans
    if not source.may_be_empty:
        source.batches = _batches(path, header, packets, source)
    return source


def _left_out(header: Header, packets: Packets, events: dict[str, int]) -> dict[str, int]:
    """Return the number of packets of every other stream.

    events: numbers of the event streams that were not chosen, by their labels.
    """
    others = {one.number: KINDS.get(one.kind, f"samples of {one.kind}") for one in header.streams if one.kind != "EVTS"}
    others |= {number: f"events of {label}" for label, number in events.items()}
    counts: Counter[str] = Counter()
    for number, name in others.items():  # a packet has one frame, but many samples
        counts[name if name == KINDS["FRME"] else f"packets of {name}"] += packets.counts.get(number, 0)
    return dict(+counts)


def _choose(
    handle: BinaryIO, header: Header, wanted: str | None, where: str
) -> tuple[str, PacketStream, dict[str, int]]:
    """Return the label of the stream, the stream, and the numbers of the other event streams by label.

    A label is the stream's name; if the file has several cameras, it is `camera/name`.
    """
    streams = [stream for stream in header.streams if stream.kind == "EVTS"]
    if not streams:
        kinds = " and ".join(dict.fromkeys(KINDS.get(stream.kind, stream.kind) for stream in header.streams))
        counts = _left_out(header, walk(handle, header, -1), {})
        message, found = (
            f"{kinds or 'no stream'} but no event stream",
            ", ".join(f"{n} {c:,}" for n, c in counts.items()),
        )
        raise InputError(f"the file has {message}", where=where, found=found, hint=NOT_RECORDED if counts else "")
    several = len({stream.camera for stream in streams}) > 1
    labels = {f"{stream.camera}/{stream.name}" if several else stream.name: stream for stream in streams}
    label = min(labels) if wanted is None else wanted
    if label not in labels:
        expected = " or ".join(sorted(labels))
        raise InputError("the file has no such event stream", where=where, expected=expected, found=label)
    return label, labels[label], {other: labels[other].number for other in sorted(set(labels) - {label})}


def _batches(path: Path, header: Header, packets: Packets, source: EventSource) -> Iterator[EventColumns]:
    """Decode all intact packets of a stream; at the end add notes on losses to `source`.

    Raises InputError if no packet can be decoded.
    """
    where = str(path)
    total = intact = count = 0
    trouble = ""
    check_libraries(where)
    waiting: list[Any] = []
    with path.open("rb") as handle:
        for events in decoded(handle, packets.spans, "EVTS", header.compression):
            if isinstance(events, str):
                trouble = trouble or events
                continue
            intact += 1
            waiting.append(events)
            count += len(events)
            if count >= BATCH_EVENTS:
                yield _columns(waiting, total)
                total, count, waiting = total + count, 0, []
        if waiting:
            yield _columns(waiting, total)
            total += count
    size = path.stat().st_size
    if not intact:
        lost = f"{size - packets.end} bytes after byte {packets.end}" if not packets.whole else trouble or "no packet"
        raise InputError("no packet of events can be read: the file is damaged", where=where, found=lost)
    if trouble:
        source.notes.append(
            f"damaged file: kept {total} events from {intact} of {len(packets.spans)} packets; {trouble}"
        )
    if not packets.whole:
        lost = f"{min(size, header.table if header.table >= 0 else size) - packets.end} bytes are lost"
        word = "damaged" if 0 <= header.table < size else "truncated"
        source.notes.append(f"{word} file: kept {total} events from {intact} complete packets; {lost}")
    elif header.table < 0:
        source.notes.append(f"the recorder never closed the file: kept {total} events from {intact} packets")
    source.cut_short = bool(trouble) or not packets.whole or header.table < 0


def _columns(packets: list[Any], first: int) -> EventColumns:
    """Return the events of some packets; `first` is the index of the first event in the file."""
    t, x, y, on = (np.concatenate([events[name] for events in packets]) for name in ("t", "x", "y", "on"))
    return EventColumns(t, x.view(np.uint16), y.view(np.uint16), on != 0, partial(at_index, first))


FORMAT = ImportFormat((b"#!AER-DAT4",), open_aedat4, ("stream",))
