"""The clock of a camera in every format: what goes back a little, wraps, pauses, or begins anew.

Each format has an encoder of a few lines here, by its published layout, which takes the ticks of the camera's clock as
they come, also backwards.
"""

import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest

from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read.time_order import OrderOptions
from evetac_cli.formats.write.event_files import AEDAT4_EVENT, aedat4_description
from tests.formats.read.bags.bag_writing import BAGS, START_S, Types, write_bag
from tests.importing import FRAME, refusal

COUNT = 400
X, Y, P = np.arange(COUNT) % 640, np.arange(COUNT) * 7 % 480, np.arange(COUNT) % 3 % 2
MARKS = 0x0123456789ABC000 + np.arange(COUNT)  # times that stand nowhere else in a file
Ticks = Sequence[int]  # of the clock, in us, as the camera counts them
Write = Callable[[Path, Ticks], Path]


def text(path: Path, t: Ticks, scale: float = 1, separator: str = " ") -> Path:
    spoken = [f"{us}" if scale == 1 else f"{us / scale:.6f}" for us in t]
    path.write_text("\n".join(separator.join((us, f"{x}", f"{y}", f"{p}")) for us, x, y, p in rows(spoken)))
    return path


def rows(t: Sequence[Any]) -> Any:
    return zip(t, X.tolist(), Y.tolist(), P.tolist(), strict=False)


def npz(path: Path, t: Ticks, dtype: str = "<i8", scale: float = 1) -> Path:
    with path.open("wb") as file:
        np.savez(file, t=column(t, dtype, scale), x=X[: len(t)], y=Y[: len(t)], p=P[: len(t)])
    return path


def column(t: Ticks, dtype: str, scale: float = 1) -> Any:
    return (np.array(t, np.int64) / scale if scale != 1 else np.array(t, np.int64)).astype(dtype)


def hdf5(path: Path, t: Ticks, names: str, dtype: str = "<i8", scale: float = 1) -> Path:
    """names: of the four columns, as in `events/{}s`."""
    with h5py.File(path, "w") as file:
        values = {"t": column(t, dtype, scale), "x": X[: len(t)], "y": Y[: len(t)], "p": P[: len(t)]}
        for name, of_name in values.items():
            file[names.format(name)] = of_name
    return path


def hdf5_table(path: Path, t: Ticks, name: str, order: str, dtype: str, scale: float = 1) -> Path:
    columns = {"t": column(t, dtype, scale), "x": X[: len(t)], "y": Y[: len(t)], "p": P[: len(t)]}
    with h5py.File(path, "w") as file:
        file[name] = np.stack([columns[one].astype(dtype) for one in order], axis=1)
    return path


def hdf5_compound(path: Path, t: Ticks) -> Path:
    events = np.zeros(len(t), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    events["t"], events["x"], events["y"], events["p"] = t, X[: len(t)], Y[: len(t)], P[: len(t)]
    with h5py.File(path, "w") as file:
        file["CD/events"] = events
    return path


def aedat2(path: Path, t: Ticks) -> Path:
    """A DAVIS640: column in bits 12 to 21 from the right, row in 22 to 30 from the bottom, polarity in bit 11."""
    words = [(639 - x) << 12 | (479 - y) << 22 | p << 11 for _, x, y, p in rows(t)]
    content = b"".join(struct.pack(">II", word, us) for word, us in zip(words, t, strict=True))
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.DAVIS640\r\n" + content)
    return path


def aedat4(path: Path, t: Ticks) -> Path:
    """Faery writes times in order only: these are written first, and then overwritten."""
    aedat = pytest.importorskip("faery").extension.aedat
    events = np.empty(len(t), AEDAT4_EVENT)
    events["t"], events["x"], events["y"], events["on"] = MARKS[: len(t)], X[: len(t)], Y[: len(t)], P[: len(t)]
    with aedat.Encoder(path, aedat4_description(aedat, FRAME), None) as encoder:
        for first in range(0, len(events), 50):
            encoder.write(0, events[first : first + 50])
    content = path.read_bytes()
    for mark, us in zip(MARKS.tolist(), t, strict=False):
        assert mark.to_bytes(8, "little") in content
        content = content.replace(mark.to_bytes(8, "little"), us.to_bytes(8, "little"))
    path.write_bytes(content)
    return path


HEAD = "% evt {0}\n% format EVT{1};height=480;width=640\n% geometry 640x480\n% end\n"


def evt2(path: Path, t: Ticks, wide: bool = False) -> Path:
    words, high = [], None
    for us, x, y, p in rows(t):
        if us >> 6 != high:
            high = us >> 6
            words.append((8 << 28 | high & 0xFFFFFFF) << 32 * wide)
        words.append(p << 28 | (us & 63) << 22 | (x // 32 * 32 if wide else x) << 11 | y)
        if wide:
            words[-1] = (words[-1] << 32) | 1 << x % 32
    head = HEAD.format("2.1", "21") if wide else HEAD.format("2.0", "2")
    path.write_bytes(head.encode() + np.array(words, "<u8" if wide else "<u4").tobytes())
    return path


def evt3_words(t: Ticks, every_high: bool) -> list[int]:
    """every_high: as sensors send them, all high bits of time; otherwise only those that an event needs."""
    words: list[int] = []
    high: int | None = None
    for us, x, y, p in rows(t):
        if us >> 12 != high:
            between = range((high if high is not None and high < us >> 12 else (us >> 12) - 1) + 1, (us >> 12) + 1)
            words += [8 << 12 | one & 0xFFF for one in (between if every_high else between[-1:])]
            high = us >> 12
        words += [6 << 12 | us & 0xFFF, y, 2 << 12 | p << 11 | x]
    return words


def evt3(path: Path, t: Ticks, every_high: bool = False) -> Path:
    path.write_bytes(HEAD.format("3.0", "3").encode() + np.array(evt3_words(t, every_high), "<u2").tobytes())
    return path


def dat(path: Path, t: Ticks, kind: int = 12, version: int = 2) -> Path:
    places = [x | y << 14 | p << 28 if version == 2 else x % 304 | y % 240 << 9 | p << 17 for _, x, y, p in rows(t)]
    content = b"".join(struct.pack("<II", us, place) for us, place in zip(t, places, strict=True))
    head = f"% Data file containing CD events.\n% Version {version}\n% Height 480\n% Width 640\n".encode()
    path.write_bytes(head + bytes((kind, 8)) + content)
    return path


class Kind(NamedTuple):
    """A format: how it is written, and ticks after which its clock begins anew; 0 where it has as many as it needs."""

    write: Write
    span: int = 0
    signed: bool = False  # the upper half of its clock is written as negative numbers
    counts_turns: bool = False  # its writer says of itself how the clock goes on

    @property
    def full_us(self) -> int:
        """When its clock begins anew for the first time."""
        return self.span // 2 if self.signed else self.span


KINDS = {
    "text": Kind(text),
    "text in s": Kind(partial(text, scale=1e6)),
    "CSV": Kind(partial(text, separator=",")),
    "npz": Kind(npz),
    "npz uint32": Kind(partial(npz, dtype="<u4"), 2**32),
    "npz int32": Kind(partial(npz, dtype="<i4"), 2**32, signed=True),
    "npz in s": Kind(partial(npz, dtype="<f8", scale=1e6)),
    "DSEC": Kind(partial(hdf5, names="events/{}")),
    "DSEC uint32": Kind(partial(hdf5, names="events/{}", dtype="<u4"), 2**32),
    "rpg": Kind(partial(hdf5, names="events/{}s", dtype="<f8", scale=1e6)),
    "M3ED": Kind(partial(hdf5, names="prophesee/left/{}")),
    "MVSEC": Kind(partial(hdf5_table, name="davis/left/events", order="xytp", dtype="<f8", scale=1e6)),
    "v2e uint32": Kind(partial(hdf5_table, name="events", order="txyp", dtype="<u4"), 2**32),
    "Prophesee HDF5": Kind(hdf5_compound),
    "AEDAT 2": Kind(aedat2, 2**32),
    "AEDAT4": Kind(aedat4),
    "EVT2": Kind(evt2, 2**34),
    "EVT2.1": Kind(partial(evt2, wide=True), 2**34),
    "EVT3": Kind(evt3, 2**24),
    "EVT3, all high bits": Kind(partial(evt3, every_high=True), 2**24, counts_turns=True),
    "DAT": Kind(dat, 2**32),
    "DAT of type 0": Kind(partial(dat, kind=0), 2**32),
    "DAT 1": Kind(partial(dat, version=1), 2**32),
}
WRAPPING = [name for name, kind in KINDS.items() if kind.span]


def written(tmp_path: Path, name: str, t: Any) -> Path:
    """A file whose camera counted these us; its clock shows what its bits hold."""
    kind = KINDS[name]
    ticks = [int(us) % kind.span if kind.span and not kind.counts_turns else int(us) for us in t]
    if kind.signed:
        ticks = [us - kind.span if us >= kind.full_us else us for us in ticks]
    return kind.write(tmp_path / "a", ticks)


def steady(start_us: int, count: int = COUNT, step_us: int = 5000) -> Any:
    return start_us + np.arange(count, dtype=np.int64) * step_us


@pytest.mark.parametrize("name", KINDS)
def test_steps_back_below_a_millisecond_are_put_in_order(tmp_path: Path, name: str) -> None:
    """Assert that events up to 999 us late come out in order, each with its own pixel, and that it is said."""
    t = steady(3_000_000)
    t[200] = t[199] - 999
    t[301:304] = t[300] - np.array([1, 300, 2])
    imported = read_events(written(tmp_path, name, t), frame_px=FRAME)
    order = np.argsort(t, kind="stable")
    assert imported.events.t.tolist() == (t[order] - t[0]).tolist()
    if name != "DAT 1":
        assert imported.events.x.tolist() == X[order].tolist()
        assert imported.events.y.tolist() == Y[order].tolist()
    assert imported.events.p.tolist() == P[order].tolist()
    assert imported.sorted == 4
    assert "4 events came up to 999 us late: sorted" in imported.notes


@pytest.mark.parametrize("name", KINDS)
def test_a_restart_is_refused_and_cut(tmp_path: Path, name: str) -> None:
    """Assert that a clock that begins anew is refused with its place, and that either part can be had."""
    first, second = steady(5_000_000, 250), steady(1000, 150)
    path = written(tmp_path, name, [*first, *second])
    words = refusal(path, frame_px=FRAME)
    assert "time goes backwards" in words and "from 6.245000 s to 0.001000 s" in words
    assert "250" in words or "line 251" in words
    assert "--from-restart N keeps one part (part 0: 250 events, part 1: 150 events)" in words
    assert "--drop-late leaves out the 150 events (38%)" in words
    assert "--sort" not in words
    for part, kept in ((0, first), (1, second)):
        imported = read_events(path, frame_px=FRAME, order=OrderOptions(from_restart=part))
        assert imported.events.t.tolist() == (kept - kept[0]).tolist()
        assert imported.t_offset_us == kept[0]
    assert read_events(path, frame_px=FRAME, order=OrderOptions(drop_late=True)).events.size == 250


@pytest.mark.parametrize("name", KINDS)
def test_single_late_events_can_be_dropped(tmp_path: Path, name: str) -> None:
    """Assert that an event a second late is refused with its place, and that dropping it leaves the others."""
    t = steady(5_000_000)
    t[290] -= 1_000_000
    path = written(tmp_path, name, t)
    words = refusal(path, frame_px=FRAME)
    assert "from 6.445000 s to 5.450000 s" in words
    assert "--drop-late leaves out the 1 event (0.25%)" in words
    assert "--sort keeps all events" in words
    imported = read_events(path, frame_px=FRAME, order=OrderOptions(drop_late=True))
    assert imported.events.t.tolist() == (np.delete(t, 290) - t[0]).tolist()
    assert imported.counts["late"] == 1


@pytest.mark.parametrize("name", KINDS)
def test_a_pause_stays_as_long_as_it_was(tmp_path: Path, name: str) -> None:
    """Assert that 12 s without an event are 12 s, and where the format can say it 100 s."""
    t = steady(2_000_000)
    t[200:] += 12_000_000 if name == "EVT3" else 100_000_000
    imported = read_events(written(tmp_path, name, t), frame_px=FRAME)
    assert imported.events.t.tolist() == (t - t[0]).tolist()


@pytest.mark.parametrize("pause_us", [0, 2_000_000])
@pytest.mark.parametrize("name", WRAPPING)
def test_a_wrap_is_followed(tmp_path: Path, name: str, pause_us: int) -> None:
    """Assert that a clock that is full goes on, with and without a pause there, and that the place is said."""
    t = steady(KINDS[name].full_us - 1_000_000)
    t[200:] += pause_us
    imported = read_events(written(tmp_path, name, t), frame_px=FRAME)
    assert imported.events.t.tolist() == (t - t[0]).tolist()
    (note,) = [note for note in imported.notes if "wrapped" in note]
    assert "wrapped once, at " in note


@pytest.mark.parametrize("before_us", [900, 4096, 5000])
@pytest.mark.parametrize("name", WRAPPING)
def test_a_file_that_begins_just_before_the_wrap(tmp_path: Path, name: str, before_us: int) -> None:
    """Assert the same where the first events are of the last or last but one count of the high bits (4095, 4094)."""
    t = steady(KINDS[name].full_us - before_us, step_us=100)
    imported = read_events(written(tmp_path, name, t), frame_px=FRAME)
    assert imported.events.t.tolist() == (t - t[0]).tolist()
    assert imported.t_offset_us == t[0] and imported.sorted == 0


@pytest.mark.parametrize("name", WRAPPING)
def test_events_late_over_a_wrap(tmp_path: Path, name: str) -> None:
    """Assert that an event from just before the wrap that comes just after it is put before it; the rest goes on."""
    t = steady(KINDS[name].full_us - 1_000_000)
    t[200:203] = KINDS[name].full_us + np.array([100, -300, 200])
    imported = read_events(written(tmp_path, name, t), frame_px=FRAME)
    assert imported.events.t.tolist() == (np.sort(t) - t[0]).tolist()
    assert imported.sorted == 1


@pytest.mark.parametrize("name", [name for name in WRAPPING if not KINDS[name].counts_turns])
def test_a_glitch_ahead_is_no_wrap(tmp_path: Path, name: str) -> None:
    """Assert that a single time near the end of the clock does not make what follows a turn later."""
    t = steady(1_000_000)
    t[200] = KINDS[name].full_us - 1_000_000
    words = refusal(written(tmp_path, name, t), frame_px=FRAME)
    assert "time goes backwards" in words or "span too much" in words


@pytest.mark.parametrize("bits", [31, 32])
@pytest.mark.parametrize("name", ["text", "npz", "DSEC", "rpg", "MVSEC", "v2e uint32", "npz int32", "AEDAT 2"])
def test_a_wrap_that_only_the_numbers_tell(tmp_path: Path, name: str, bits: int) -> None:
    """Assert that a clock of 31 or 32 bits in a wider column is followed, from its very end to its beginning."""
    if (name, bits) == ("npz int32", 32):
        pytest.skip("its own clock")
    t = steady((1 << bits) - 1_000_000)
    path = KINDS[name].write(tmp_path / "a", (t % (1 << bits)).tolist())
    imported = read_events(path, frame_px=FRAME)
    assert imported.events.t.tolist() == (t - t[0]).tolist()
    far = KINDS[name].write(tmp_path / "b", [*steady((1 << bits) - 300_000_000, 200), *steady(100_000_000, 200)])
    if name not in ("v2e uint32", "AEDAT 2", "npz int32"):
        assert "time goes backwards" in refusal(far, frame_px=FRAME)


@pytest.mark.parametrize("kind", BAGS)
@pytest.mark.parametrize("encoding", ["dvs_msgs", "mono", "libcaer", "evt3"])
def test_clocks_in_bags(tmp_path: Path, kind: str, encoding: str) -> None:
    """Assert the same of bags: small steps back, a restart, and of evt3 a wrap with lost messages."""
    types = Types(kind)

    def written(name: str, t: Any) -> Path:
        messages = []
        for first in range(0, len(t), 50):
            part = slice(first, first + 50)
            base_us = int(t[part].min())
            events = list(zip(t[part].tolist(), X[part].tolist(), Y[part].tolist(), P[part].tolist(), strict=True))
            if encoding == "dvs_msgs":
                messages.append(types.array([(us + START_S * 10**6, x, y, p) for us, x, y, p in events]))
                continue
            if encoding == "mono":
                words = [p << 63 | y << 48 | x << 32 | (us - base_us) * 1000 for us, x, y, p in events]
                content = np.array(words, "<u8").tobytes()
            elif encoding == "libcaer":
                content = b"".join(
                    struct.pack("<II", x << 17 | y << 2 | p << 1 | 1, us - base_us) for us, x, y, p in events
                )
            else:
                # each message begins with the high bits of its time, as drivers send them
                content = np.array(evt3_words_of(events), "<u2").tobytes()
            messages.append(types.packet(content, encoding, first // 50, base_us * 1000))
        return write_bag(tmp_path, kind, types, {"/e": messages}, name=name)

    t = steady(3_000_000)
    t[200] = t[199] - 999
    imported = read_events(written("small", t))
    assert (imported.events.t.tolist(), imported.sorted) == ((np.sort(t) - t[0]).tolist(), 1)
    first, second = steady(5_000_000, 250), steady(1000, 150)
    path = written("restart", np.concatenate([first, second]))
    assert "in message 5, event 0" in refusal(path) or "at index 250" in refusal(path)
    assert read_events(path, order=OrderOptions(from_restart=1)).events.t.tolist() == (second - second[0]).tolist()
    if encoding == "evt3":
        t = steady(2**24 - 1_000_000)
        t[200:] += 2_000_000
        imported = read_events(written("wrap", t))
        assert imported.events.t.tolist() == (t - t[0]).tolist()
        assert any("wrapped once, in message 4" in note for note in imported.notes)


def evt3_words_of(events: Sequence[tuple[int, int, int, int]]) -> list[int]:
    words: list[int] = []
    high = -1
    for us, x, y, p in events:
        if us >> 12 != high:
            high = us >> 12
            words.append(8 << 12 | high & 0xFFF)
        words += [6 << 12 | us & 0xFFF, y, 2 << 12 | p << 11 | x]
    return words
