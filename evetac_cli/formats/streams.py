"""Files of other programs that hold a stream of a trial, brought into the clock of a recording: one function.

The content decides, not the file's name: a bag of ROS 1 or ROS 2, Parquet, else CSV.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError, cannot_read
from evetac_cli.events import SLICE_US
from evetac_cli.formats.imports import BAG
from evetac_cli.formats.read.bags.bag_files import is_bag_folder
from evetac_cli.formats.read.bags.host_clock import clock_of_bag, on_sensor_clock
from evetac_cli.formats.read.bags.read_bag_stream import read_bag_stream
from evetac_cli.formats.read.read_table import read_table
from evetac_cli.store.recordings.streams import Stream
from evetac_cli.text_files import open_regular, steady


def read_stream(source: str, name: str, folder: Path | None = None) -> tuple[Stream, list[str]]:
    """A stream in its own clock, and notes on what was left out; InputError in words.

    source: a file, or FILE:/TOPIC of a bag. folder: on whose disk the samples wait.
    """
    path, topic = _parted(source)
    try:
        with steady(path):
            if _is_bag(path):
                stream, notes = read_bag_stream(path, topic, folder)
            elif topic:
                raise InputError("only a bag has topics", where=str(path), found=topic)
            else:
                stream, notes = read_table(path, folder)
    except OSError as error:
        raise cannot_read(error, path) from error
    except MemoryError as error:
        raise InputError("does not fit in memory", where=str(path), hint="a damaged file?") from error
    back = np.flatnonzero(stream.t_us[1:] < stream.t_us[:-1])
    if len(back):
        at = int(back[0])
        raise InputError(
            "times go backwards",
            where=f"{source}: sample {at + 2}",
            expected=f"at least {stream.t_us[at] / 1e6:.6f} s",
            found=f"{stream.t_us[at + 1] / 1e6:.6f} s",
            hint="sort its rows by time, if they are of one clock",
        )
    return replace(stream, name=name), notes


def on_clock_of_events(stream: Stream, source: str, span_us: tuple[int, int]) -> tuple[Stream, str]:
    """A stream of a bag whose events are on the sensor's own clock brought to that, and a note; else as it is.

    span_us: from when to when the recording is, on the clock of its events: only one that is on the sensor's counts.
    """
    path, _ = _parted(source)
    if not _is_bag(path):
        return stream, ""
    clock = clock_of_bag(path, span_us)
    return (stream, "") if clock is None else on_sensor_clock(stream, clock, span_us)


def aligned(stream: Stream, offset_s: float, t_offset_us: int, slices: int, source: str) -> Stream:
    """The samples of a stream within a recording, in its clock; InputError where there is none.

    offset_s: what brings the stream's clock to that of the event file. t_offset_us: where the recording begins in that.
    """
    shift_us = round(offset_s * 1e6) - t_offset_us
    moved = replace(stream, t_us=stream.t_us + shift_us, offset_s=stream.offset_s + offset_s)
    within = moved.within(slices)
    if len(within.t_us):
        return within
    first_s, last_s = (int(stream.t_us[at]) / 1e6 + offset_s for at in (0, -1))
    start_s = t_offset_us / 1e6
    begins_s = start_s - int(stream.t_us[0]) / 1e6
    raise InputError(
        f"no sample of {stream.name} lies within the recording",
        where=source,
        expected=f"times from {start_s:.6f} to {start_s + slices * SLICE_US / 1e6:.6f} s, in the clock of the events",
        found=f"{first_s:.6f} to {last_s:.6f} s ({stream.clock})",
        hint=f"--offset {stream.name}={begins_s:.6f} if both began at the same time",
    )


def _parted(source: str) -> tuple[Path, str]:
    """The file and the topic that FILE:/TOPIC names; a file of that very name comes first."""
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
