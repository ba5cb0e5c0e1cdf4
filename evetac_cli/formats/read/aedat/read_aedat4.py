"""Read events from AEDAT4 files (iniVation): the intact packets of one event stream."""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.note import read_note
from evetac_cli.formats.read.aedat.aedat4_packets import (
    KINDS,
    Header,
    Packets,
    PacketStream,
    Span,
    decoded,
    listed_spans,
    packet_table,
    read_header,
    walk,
)
from evetac_cli.formats.read.aedat.aedat4_payloads import check_libraries
from evetac_cli.formats.read.source import NOT_RECORDED, EventColumns, EventSource, at_index, choose_frame

BATCH_EVENTS = 1 << 18  # a packet has some thousand events


def open_aedat4(path: Path, frame_px: tuple[int, int] | None, stream: str | None = None) -> EventSource:
    """Return the events of the named stream, or the first by name; frame_px is only for files that do not state it."""
    where = str(path)
    with path.open("rb") as handle:
        header = read_header(handle, where)
        label, event_stream, others = _choose(handle, header, stream, where)
        packets = walk(handle, header, event_stream.number)
        left_out = _left_out(handle, header, packets, others)
    source = EventSource("aedat4", choose_frame(event_stream.frame_px, frame_px, where), ())
    source.note = read_note(event_stream.note, where) if event_stream.note else None
    if others:
        source.notes.append(
            f"read the event stream {label}; the file also has: {', '.join(others)} (choose with --stream)"
        )
    source.left_out |= left_out
    source.may_be_empty = packets.whole and header.table >= 0 and not packets.spans
    if not source.may_be_empty:
        source.batches = _batches(path, header, event_stream.number, packets, source)
    return source


def _left_out(handle: BinaryIO, header: Header, packets: Packets, events: dict[str, int]) -> dict[str, int]:
    """Return the amount of data in every other stream: samples if there is a packet table, otherwise packets.

    events: numbers of the event streams that were not chosen, by their labels.
    """
    others = {one.number: KINDS.get(one.kind, f"samples of {one.kind}") for one in header.streams if one.kind != "EVTS"}
    others |= {number: f"events of {label}" for label, number in events.items()}
    if not any(packets.counts.get(number) for number in others):
        return {}
    check_libraries(handle.name)
    rows = packet_table(handle, header)
    counts: Counter[str] = Counter()
    for number, name in others.items():
        count = packets.counts.get(number, 0)
        if rows is not None:
            counts[name] += int(rows["elements_count"][rows["track_id"] == number].sum())
        elif count:  # a packet has one frame, but many samples
            counts[name if name == KINDS["FRME"] else f"packets of {name}"] += count
    return {name: count for name, count in counts.items() if count > 0}


def _choose(
    handle: BinaryIO, header: Header, wanted: str | None, where: str
) -> tuple[str, PacketStream, dict[str, int]]:
    """Return the label of the stream, the stream, and the numbers of the other event streams by label.

    A label is the stream's name; if the file has several cameras, it is `camera/name`.
    """
    streams = [stream for stream in header.streams if stream.kind == "EVTS"]
    if not streams:
        kinds = dict.fromkeys(KINDS.get(stream.kind, stream.kind) for stream in header.streams)
        counts = _left_out(handle, header, walk(handle, header, -1), {})
        raise InputError(
            f"the file has {' and '.join(kinds) or 'no streams at all'} but no event stream",
            where=where,
            found=", ".join(f"{name} {count:,}" for name, count in counts.items()),
            hint=NOT_RECORDED if counts else "",
        )
    several = len({stream.camera for stream in streams}) > 1
    labels = {f"{stream.camera}/{stream.name}" if several else stream.name: stream for stream in streams}
    label = min(labels) if wanted is None else wanted
    if label not in labels:
        raise InputError(
            "the file has no such event stream", where=where, expected=" or ".join(sorted(labels)), found=label
        )
    return label, labels[label], {other: labels[other].number for other in sorted(set(labels) - {label})}


def _batches(path: Path, header: Header, number: int, packets: Packets, source: EventSource) -> Iterator[EventColumns]:
    """Decode all intact packets of a stream; at the end add notes on losses to `source`.

    Raises InputError if no packet can be decoded.
    """
    where = str(path)
    size = path.stat().st_size
    total = intact = 0
    trouble = ""
    check_libraries(where)
    with path.open("rb") as handle:
        listed = listed_spans(handle, header, number)
        led_past = listed is not None and len(listed) > len(packets.spans)
        spans = listed if listed is not None and led_past else packets.spans
        waiting: list[Any] = []
        count = 0
        for events in decoded(handle, spans, "EVTS", header.compression):
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
    if not intact:
        lost = f"{size - packets.end} bytes after byte {packets.end}" if not packets.whole else trouble or "no packet"
        raise InputError("no packet of events can be read: the file is damaged", where=where, found=lost)
    source.notes += _damage(header, packets, size, (total, intact, len(spans)), trouble, listed, led_past=led_past)
    source.cut_short = intact < len(spans) or (not packets.whole and not led_past) or header.table < 0


def _columns(packets: list[Any], first: int) -> EventColumns:
    """Return the events of some packets; `first` is the index of the first event in the file."""
    t, x, y, on = (np.concatenate([events[name] for events in packets]) for name in ("t", "x", "y", "on"))
    return EventColumns(t, x.view(np.uint16), y.view(np.uint16), on != 0, partial(at_index, first))


def _damage(
    header: Header,
    packets: Packets,
    size: int,
    counts: tuple[int, int, int],
    trouble: str,
    listed: list[Span] | None,
    *,
    led_past: bool,
) -> Iterator[str]:
    """Yield notes on damage to a file; counts: events, decoded packets, packets."""
    total, intact, count = counts
    if intact < count:
        yield f"damaged file: kept {total} events from {intact} of {count} packets; {trouble}"
    if led_past:
        yield f"a packet at byte {packets.end} is damaged; the packet table gave the position of the next one"
    elif not packets.whole:
        lost = min(size, header.table if header.table >= 0 else size) - packets.end
        word = "damaged" if 0 <= header.table < size else "truncated"
        yield f"{word} file: kept {total} events from {intact} complete packets; {lost} bytes are lost"
    elif header.table < 0:
        yield f"the recorder never closed the file: kept {total} events from {intact} packets"
    elif listed is None and intact == count:
        yield f"the packet table is damaged: read all {intact} packets without it"
