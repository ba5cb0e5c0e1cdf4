"""Read another program's file with a stream of a trial, and convert its times to the clock of a recording.

The format is recognized by content, not by file name: a bag of ROS 1 or ROS 2, Parquet, otherwise CSV.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.formats.imports import BAG
from evetac_cli.formats.read.bags.bag_files import is_bag_folder
from evetac_cli.formats.read.bags.host_clock import clock_of_bag, on_sensor_clock
from evetac_cli.formats.read.bags.read_bag_stream import read_bag_stream
from evetac_cli.formats.read.damage import reading
from evetac_cli.formats.read.read_table import read_table
from evetac_cli.store.recordings.streams import Stream
from evetac_cli.text_files import FileStamps, open_regular


def read_stream(
    source: str, name: str, folder: Path | None = None, length_s: float = math.inf
) -> tuple[Stream, list[str]]:
    """Return a stream in its own clock, and notes on what was left out; raise InputError if it cannot be read.

    source: a file, or FILE:/TOPIC of a bag. folder: where the samples are stored temporarily.
    length_s: length of the recording, which an assumed unit of time has to fit.
    """
    path, topic = _parted(source)
    before = FileStamps(path)
    with reading(path, before):
        if _is_bag(path):
            stream, notes = read_bag_stream(path, topic, folder)
        elif topic:
            raise InputError("a topic was given, but the file is not a bag", where=str(path), found=topic)
        else:
            stream, notes = read_table(path, folder, length_s)
    before.check()
    back = np.flatnonzero(stream.t_us[1:] < stream.t_us[:-1])
    if len(back):
        at = int(back[0])
        earlier, later = (f"{stream.t_us[row] / 1e6:.6f} s" for row in (at, at + 1))
        message, where = "the times of the stream go backwards", f"{source}: sample {at + 2}"
        raise InputError(
            message, where=where, expected=f"at least {earlier}", found=later, hint="sort the rows by time"
        )
    return replace(stream, name=name), notes


def on_clock_of_events(stream: Stream, source: str, span_us: tuple[int, int]) -> tuple[Stream, str]:
    """Return a bag's stream on the sensor's clock, and a note, if the bag's events use that clock; else it unchanged.

    span_us: begin and end of the recording on the clock of its events. It matters only if that is the sensor's clock.
    """
    path, _ = _parted(source)
    if not _is_bag(path):
        return stream, ""
    clock = clock_of_bag(path, span_us)
    return (stream, "") if clock is None else on_sensor_clock(stream, clock, span_us)


def aligned(stream: Stream, offset_s: float, t_offset_us: int, slices: int, source: str) -> Stream:
    """Return the samples of a stream within a recording, in its clock; raise InputError if there are none.

    offset_s: added to the stream's times to get times on the event file's clock.
    t_offset_us: begin of the recording on the event file's clock.
    """
    shift_us = round(offset_s * 1e6) - t_offset_us
    moved = replace(stream, t_us=stream.t_us + shift_us, offset_s=stream.offset_s + offset_s)
    within = moved.within(slices)
    if len(within.t_us):
        return within
    first_s, last_s = (int(stream.t_us[at]) / 1e6 + offset_s for at in (0, -1))
    start_s = t_offset_us / 1e6
    message, found = f"no sample of {stream.name} is within the recording", f"{first_s:.6f} to {last_s:.6f} s"
    expected = f"times from {start_s:.6f} to {start_s + slices * SLICE_US / 1e6:.6f} s, on the clock of the events"
    begins = f"{stream.name}={start_s - int(stream.t_us[0]) / 1e6:.6f}"
    hint = f"--offset {begins} if stream and events began at the same time"
    raise InputError(message, where=source, expected=expected, found=f"{found} ({stream.clock})", hint=hint)


def _parted(source: str) -> tuple[Path, str]:
    """Split FILE:/TOPIC into file and topic; if a file has exactly this name, the topic is empty."""
    before, colon, topic = source.rpartition(":/")
    if not colon or not before or Path(source).exists():
        return Path(source), ""
    return Path(before), f"/{topic}"


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        if not is_bag_folder(path):
            raise InputError("this is a folder", where=str(path), expected="CSV, Parquet, or a bag")
        return True
    with open_regular(path) as file:
        head = file.read(max(map(len, BAG.begins)))
    return head.startswith(BAG.begins)
