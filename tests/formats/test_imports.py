"""Foreign event files: what comes in is right, or it is refused in words."""

import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from evetac_cli.commands.record import Record
from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate, slice_starts
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read import read_text, source
from evetac_cli.formats.read.source import CleanEvents, EventColumns, EventSource
from evetac_cli.formats.read.time_order import OrderOptions
from evetac_cli.jobs import Outcome
from evetac_cli.store.files import StageFile
from evetac_cli.trials import record
from tests.importing import FRAME, event_rows, refusal, same
from tests.make import run_stage
from tests.patience import PATIENCE_S


def columns(t: Any, x: Any = None, y: Any = None, p: Any = None, first: int = 0) -> EventColumns:
    """A batch as readers make it; what a test does not care about is 0."""
    t = np.asarray(t)
    x, y, p = (np.zeros(len(t), np.int64) if column is None else np.asarray(column) for column in (x, y, p))
    return EventColumns(t, x, y, p, lambda row: f"at index {first + row}")


# --- validation of events -----------------------------------------------------------------------------------------

INTEGERS = st.sampled_from(["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"]).map(np.dtype)


@st.composite
def integer_batches(draw: st.DrawFn) -> EventColumns:
    """Any integer columns, near what is allowed often enough to get through."""
    size = draw(st.integers(0, 12))

    def column(low: int, high: int) -> Any:
        dtype = draw(INTEGERS)
        info = np.iinfo(dtype)
        near = st.integers(max(low, int(info.min)), min(high, int(info.max)))
        values = near if draw(st.integers(0, 5)) else st.integers(int(info.min), int(info.max))
        return draw(hnp.arrays(dtype, size, elements=values))

    return columns(column(-3000, 3000), column(-2, 12), column(-2, 9), column(0, 1))


def cleaned(
    batches: Iterable[EventColumns], frame_px: tuple[int, int], may_be_empty: bool = False, **options: Any
) -> tuple[Events, CleanEvents]:
    """The events that validation gives out, joined, and what it found."""
    source = EventSource("", frame_px, batches, may_be_empty=may_be_empty)
    clean = CleanEvents(source, OrderOptions(**options))
    return concatenate(list(clean.blocks())), clean


@settings(max_examples=300)
@given(integer_batches(), st.booleans())
def test_whatever_integers_come_in_invariants_come_out(batch: EventColumns, sort: bool) -> None:
    """Assert that validation gives what a plain loop over Python integers gives, or refuses."""
    width, height = 10, 7
    rows = [tuple(int(value) for value in row) for row in zip(*batch[:4], strict=True)]
    inside = [row for row in rows if 0 <= row[1] < width and 0 <= row[2] < height]
    back = [max(row[0] for row in inside[:i]) - inside[i][0] for i in range(1, len(inside))]
    polarities = {row[3] for row in rows}
    must_refuse = (
        not (polarities <= {0, 1} or polarities <= {-1, 1})
        or any(abs(row[0]) >= 2**53 for row in rows)
        or not inside
        or (any(us >= 1000 for us in back) and not sort)
        or (inside and max(row[0] for row in inside) - min(row[0] for row in inside) > 6 * 3600 * 10**6)
    )
    if must_refuse:
        with pytest.raises(InputError):
            cleaned([batch], (width, height), sort=sort)
        return
    events, source = cleaned([batch], (width, height), sort=sort)
    expected = sorted(inside, key=lambda row: row[0])  # stable, as validation must be
    first_us = expected[0][0] if expected else 0
    assert [column.dtype for column in events] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert [tuple(int(value) for value in row) for row in zip(*events, strict=True)] == [
        (t - first_us, x, y, int(p > 0)) for t, x, y, p in expected
    ]
    assert source.first_us == first_us
    assert source.dropped == {"not_a_number": 0, "out_of_frame": len(rows) - len(inside)}
    assert source.sorted == sum(us > 0 for us in back)


@given(st.lists(st.integers(0, 40), min_size=1, max_size=30), st.data())
def test_cuts_between_batches_do_not_matter(times: list[int], data: st.DataObject) -> None:
    """Assert that events and counts are the same however a reader cuts its batches."""
    t = np.array(times, np.uint32)
    x = np.arange(len(t)) % 5
    p = np.where(np.arange(len(t)) % 2, 1, -1)
    cuts = [0, *sorted(data.draw(st.lists(st.integers(0, len(t)), max_size=4))), len(t)]
    parts = [columns(t[a:b], x[a:b], None, p[a:b]) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    whole = cleaned([columns(t, x, None, p)], (4, 4), sort=True)
    cut = cleaned(parts, (4, 4), sort=True)
    assert same(whole[0], cut[0])
    found = ("size", "first_us", "last_us", "dropped", "sorted", "corrections")
    assert [getattr(whole[1], name) for name in found] == [getattr(cut[1], name) for name in found]


def test_time_that_goes_backwards_is_counted_and_placed() -> None:
    """Assert that the refusal places steps back of 1 ms in the file and says what each option keeps, and these do."""
    batches = [columns([10, 20, 3000]), columns([1, 3000, 2500, 2900, 3100], x=[99, 0, 1, 2, 3], first=3)]
    events, source = cleaned(batches, (9, 9))
    assert events.t.tolist() == [0, 10, 2490, 2890, 2990, 2990, 3090]
    assert (source.first_us, source.sorted, source.dropped["out_of_frame"]) == (10, 2, 1)
    assert source.corrections == ["2 events came up to 500 us late: sorted"]
    batches = [columns([10, 20, 3000]), columns([5, 3000, 2000, 2500, 3100], first=3)]
    with pytest.raises(InputError) as refused:
        cleaned(batches, (9, 9))
    words = str(refused.value)
    assert "at index 3 from 0.003000 s to 0.000005 s, at index 5 from 0.003000 s to 0.002000 s" in words
    assert "--from-restart N keeps one part (part 0: 3 events, part 1: 2 events, part 2: 3 events)" in words
    assert "--drop-late leaves out the 2 events (25%)" in words
    events, source = cleaned(batches, (9, 9), drop_late=True)
    assert (events.t.tolist(), source.dropped["late"]) == ([0, 10, 2490, 2990, 2990, 3090], 2)
    for part, kept in enumerate([[0, 10, 2990], [0, 2995], [0, 500, 1100]]):
        events, source = cleaned(batches, (9, 9), from_restart=part)
        assert (events.t.tolist(), source.dropped["other_parts"]) == (kept, 8 - len(kept))
    with pytest.raises(InputError, match="no such part"):
        cleaned(batches, (9, 9), from_restart=3)
    with pytest.raises(InputError, match="no such part"):
        cleaned(batches[:1], (9, 9), from_restart=1)


@pytest.mark.parametrize("step_us", [0, 999])
def test_very_many_events_of_one_millisecond(monkeypatch: pytest.MonkeyPatch, step_us: int) -> None:
    """Assert that events which are late by less than 1 ms are sorted, in blocks of a bounded size."""
    monkeypatch.setattr(source, "BLOCK_EVENTS", 64)

    def batches() -> Iterable[EventColumns]:
        for first in range(0, 10**5, 100):
            t = np.where(np.arange(100) % 2, 7, 7 + step_us)
            yield columns(t, np.full(100, first // 100 % 9), np.arange(100) % 2)

    blocks = list(CleanEvents(EventSource("", (9, 9), batches()), OrderOptions(sort=True)).blocks())
    assert max(block.size for block in blocks) <= 100
    events = concatenate(blocks)
    order = np.argsort(np.tile([step_us, 0], 50_000), kind="stable")
    assert events.t.tolist() == np.tile([step_us, 0], 50_000)[order].tolist()
    assert events.x.tolist() == (np.arange(10**5) // 100 % 9)[order].tolist()
    assert events.y.tolist() == (np.arange(10**5) % 2)[order].tolist()


def test_what_is_no_number_is_dropped_and_counted() -> None:
    """Assert that NaN and infinity in any column cost that event only."""
    t = [0.0, np.nan, 2.0, -np.inf, 4.6]
    events, source = cleaned([columns(t, x=[1.0, 1, np.inf, 1, 2], p=[1, 1, 1, 1, -1.0])], (9, 9))
    assert source.dropped == {"not_a_number": 3, "out_of_frame": 0}
    assert (events.t.tolist(), events.x.tolist(), events.p.tolist()) == ([0, 5], [1, 2], [1, 0])


@pytest.mark.parametrize(
    ("batch", "words"),
    [
        (columns([0, 1], p=[1, 2]), "unknown polarity"),
        (columns([0, 1], p=np.array([0, 255], np.uint8)), "two conventions.*\n.*\n.*0 and 255"),
        (columns([0, 1, 2], p=[-1, 0, 1]), "two conventions"),
        (columns([0, 1], x=[3.0, 3.5]), "x is not a whole pixel.*\n.*\n.*3.5 at index 1"),
        (columns(np.array([0, 2**63], np.uint64)), "time out of range.*\n.*\n.*9223372036854775808 at index 1"),
        (columns([0.0, 1e30]), "time out of range"),
        (columns([0, 6 * 3600 * 10**6 + 1]), "span too much"),
        (columns([0, 1], x=[10, -1]), "none of the events can be used"),
        (columns([np.nan]), "none of the events can be used"),
        (columns([0, 1], x=[0]), "columns differ in length.*\n.*\n.*t 2, x 1, y 2, p 2"),
    ],
)
def test_columns_that_mean_something_else_are_refused(batch: EventColumns, words: str) -> None:
    """Assert that validation says what is wrong and where, instead of making something up."""
    with pytest.raises(InputError, match=words):
        cleaned([batch], (10, 10))


def test_the_longest_span_still_passes() -> None:
    """Assert that 6 h are allowed, to the microsecond."""
    assert cleaned([columns([-5, 6 * 3600 * 10**6 - 5])], (1, 1))[0].t[-1] == 6 * 3600 * 10**6


# --- text ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def text(tmp_path: Path) -> Callable[..., Path]:
    """Write a text file."""

    def write(content: str | bytes, name: str = "a.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


ROWS = [(0, 1, 2, 1), (1500, 3, 4, 0), (2000, 5, 6, 1)]


@pytest.mark.parametrize(
    "content",
    [
        "1000 1 2 1\n2500 3 4 0\n3000 5 6 1\n",
        "1000 1 2 1\n2500 3 4 -1\n3000 5 6 1",
        "0.001 1 2 1\n0.0025 3 4 0\n3e-3 5 6 1\n",
        "1000,1,2,1\n2500, 3 ,4,0\n3000,5,6,1\n",
        "# t x y p\n\n1000\t1\t2\t1\n  2500 3 4 0 # here\n#\n3000 5 6 1\n",
        "1000 1 2 1\r\n2500 3 4 0\r\n3000 5 6 1\r\n",
        "\ufeff1000 1 2 1\n2500 3 4 0\n3000 5 6 1\n",
        "1000.0 1.0 2.000e+00 1.0\n2500 3 4 0\n3e3 5 6 1\n".replace("1000.0", "1000"),
        "x,y,p,t\n1,2,1,1000\n3,4,0,2500\n5,6,1,3000\n",
        "t_us p y x\n1.0e3 1 2 1\n2.5e3 0 4 3\n3.0e3 1 6 5\n",
        "# made by me\nt_s x y p\n1 1 2 1\n1.0015 3 4 0\n1.002 5 6 1\n",
    ],
)
def test_every_way_to_write_text_reads_the_same(text: Callable[..., Path], content: str) -> None:
    """Assert that separators, comments, line ends, units, polarity codes and column orders do not change the events."""
    imported = read_events(text(content), frame_px=FRAME)
    assert event_rows(imported) == ROWS
    assert (imported.format, imported.slices, imported.frame_px, imported.left_out) == ("text", 3, FRAME, {})
    assert all(note.startswith("assumed: ") for note in imported.notes)
    assert imported.t_offset_us in (1000, 1_000_000)


def test_a_line_of_names_says_order_and_unit(text: Callable[..., Path]) -> None:
    """Assert that a file can name its columns and its unit, and that other names are no names."""
    path = text("x,y,p,t_s\n1,2,1,0\n3,4,0,0.0015\n5,6,1,0.002\n")
    imported = read_events(path, frame_px=FRAME)
    assert (event_rows(imported), imported.notes) == (ROWS, [])
    assert event_rows(read_events(text("t_ms x y p\n0 1 2 1\n1.5 3 4 0\n2 5 6 1\n"), frame_px=FRAME)) == ROWS
    assert "line 1: 't_min x y p'" in refusal(text("t_min x y p\n0 1 2 1\n"), frame_px=FRAME)
    assert "line 2: 't_us x y p'" in refusal(text("t x y p\nt_us x y p\n0 1 2 1\n"), frame_px=FRAME)


CSV = {
    "pandas with its index": ",t,x,y,p\n0,1000,1,2,1\n1,2500,3,4,0\n2,3000,5,6,1\n",
    "names of data sets": "timestamp,x,y,polarity\n1000,1,2,1\n2500,3,4,-1\n3000,5,6,1\n",
    "quoted": '"x","y","pol","ts"\n1,2,1,0.001\n3,4,0,0.0025\n5,6,1,0.003\n',
    "a text between": "t,x,y,p,label\n1000,1,2,1,no slip\n2500,3,4,0,\n3000,5,6,1,slip\n",
    "named by a comment": "# x y p t\n1 2 1 1000\n3 4 0 2500\n5 6 1 3000\n",
    "Prophesee": "%geometry:640,480\n1,2,1,1000\n3,4,0,2500\n5,6,1,3000\n",
    "Prophesee, named": "%geometry:640,480\n%x,y,p,t\n1,2,1,1000\n3,4,0,2500\n5,6,1,3000\n",
    "rpg": "640 480\n0.001 1 2 1\n0.0025 3 4 0\n0.003 5 6 1\n",
    "x y t p": "1,2,0.001,1\n3,4,0.0025,0\n5,6,0.003,1\n",
}


@pytest.mark.parametrize("name", CSV)
@pytest.mark.parametrize("block", [8, 1 << 22])
def test_csv_of_other_programs(
    text: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, name: str, block: int
) -> None:
    """Assert that CSV with and without a header, in other orders and with other columns, reads the same."""
    monkeypatch.setattr(read_text, "BLOCK_CHARS", block)
    imported = read_events(text(CSV[name], "a.csv"), frame_px=FRAME)
    assert (event_rows(imported), imported.t_offset_us) == (ROWS, 1000)


@pytest.mark.parametrize("block", [1 << 22, 7])
def test_lines_without_content_may_hold_blanks(
    text: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """Assert that blanks alone, or before a comment, are no event, whatever separates the columns."""
    monkeypatch.setattr(read_text, "BLOCK_CHARS", block)
    for sign in (",", ";", " "):
        lines = ["7000 1 2 1", "  ", "7005 3 4 0", "\t# 5", " % 6", "7010 5 6 1", "   "]
        imported = read_events(text("\r\n".join(line.replace(" ", sign) if line[0] == "7" else line for line in lines)))
        assert event_rows(imported) == [(0, 1, 2, 1), (5, 3, 4, 0), (10, 5, 6, 1)]


def test_text_may_say_its_frame(text: Callable[..., Path]) -> None:
    """Assert that rpg's first line and Prophesee's comment are the frame, and no other is taken."""
    for name in ("rpg", "Prophesee", "Prophesee, named"):
        assert read_events(text(CSV[name])).frame_px == FRAME
        assert "leave out --frame-size" in refusal(text(CSV[name]), frame_px=(346, 260))


def test_a_few_events_in_disorder_are_no_other_order(text: Callable[..., Path]) -> None:
    """Assert that a column which rises by chance is not taken for the time."""
    assert "time goes backwards" in refusal(text("9000 1 1 1\n8000 2 2 1\n7000 3 3 1\n"), frame_px=FRAME)


@settings(max_examples=50)
@given(
    start=st.integers(-(10**15), 10**15),
    steps=st.lists(st.integers(0, 10**6), min_size=1, max_size=20),
    seconds=st.booleans(),
    block=st.integers(1, 200),
)
def test_text_holds_microseconds_exactly(
    tmp_path_factory: pytest.TempPathFactory, start: int, steps: list[int], seconds: bool, block: int
) -> None:
    """Assert that times on a clock of 30 years survive text in either unit, however the file is cut into blocks."""
    t = start + np.cumsum([0, *steps])
    path = tmp_path_factory.mktemp("text") / "a.csv"
    spoken = [f"{'-' if us < 0 else ''}{abs(us) // 10**6}.{abs(us) % 10**6:06d}" if seconds else f"{us}" for us in t]
    path.write_text("".join(f"{time},{i % 7},{i % 5},{i % 2}\n" for i, time in enumerate(spoken)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(read_text, "BLOCK_CHARS", block)
        imported = read_events(path, frame_px=(7, 5))
    assert imported.t_offset_us == start
    assert imported.events.t.tolist() == (t - start).tolist()
    assert imported.events.x.tolist() == [i % 7 for i in range(len(t))]


@pytest.mark.parametrize("block", [8, 1 << 22])
@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        ("0 1 2 1\n5 1 2\n", 2, "4 numbers separated by blanks"),
        ("0 1 2 1\n# c\n\n5 1 2", 4, "remove that line"),
        ("0,1,2,1\n5 1 2 1\n", 2, "separated by commas"),
        ("0 1 2 1\n1_0 1 2 1\n", 2, "4 numbers"),
        (b"0 1 2 1\n5 1 2 1\n\x07\x00\xff\xfe garbled\n", 3, "4 numbers"),
        ("secs,nsecs,x,y,polarity\n1,2,3,4,1\n", 1, "no column has a name for t"),
        ("t;x;y;polarität\n0;1;2;1\n", 1, "no column has a name for p"),
        ("0 1 2 1\n0.5 1 2 1\n", 2, "the unit of time changes"),
        (f"0 1 2 1\n{10**400} 1 2 1\n5 5.5 1 1\n", 3, "not a whole pixel"),
        ("0 1 2 1\n9000 1 2 1\n4 1 2 1\n", 3, "time goes backwards"),
    ],
)
def test_bad_lines_are_refused_by_number(
    text: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, content: str | bytes, line: int, words: str, block: int
) -> None:
    """Assert that the user is told which line is wrong, as an editor counts them, and in what way."""
    monkeypatch.setattr(read_text, "BLOCK_CHARS", block)
    refused = refusal(text(content), frame_px=FRAME)
    assert words in refused
    assert f"line {line}" in refused


def test_text_outside_frame_and_not_a_number_is_counted(text: Callable[..., Path]) -> None:
    """Assert that single events that cannot be used are dropped, each by its reason."""
    path = text(f"0 1 2 1\nnan 1 2 1\n3 -1 2 1\n4 640 2 0\n5 {2**70} 2 1\ninf 1 2 1\n-INF 2 2 0\n6 639 479 1\n")
    imported = read_events(path, frame_px=FRAME)
    assert imported.counts == {"not_a_number": 3, "out_of_frame": 3}
    assert event_rows(imported) == [(0, 1, 2, 1), (6, 639, 479, 1)]


def test_the_frame_is_guessed_among_known_sensors(text: Callable[..., Path]) -> None:
    """Assert that the smallest sensor that holds all events is taken and said, and that beyond all it is asked for."""
    for last, frame in (((127, 127), (128, 128)), ((345, 1), (346, 260)), ((1, 300), (320, 320)), ((639, 0), FRAME)):
        path = text("0 1 2 1\n2 nan nan 1\n5 {} {} 0\n".format(*last))
        imported = read_events(path)
        assert imported.frame_px == frame
        assert imported.counts["out_of_frame"] == 0
        (said,) = (note for note in imported.notes if "--frame-size" in note)
        assert "assumed {}x{}".format(*frame) in said
    path = text("0 1 2 1\n1 4000 2 1\n")
    assert "does not state its frame size" in refusal(path)
    for frame in ((0, 480), (640, -1), (70000, 1)):
        assert "impossible frame size" in refusal(path, frame_px=frame)


def test_text_without_events(text: Callable[..., Path]) -> None:
    """Assert that neither a line of names nor comments alone are a recording, with a frame or without."""
    for content in ("t,x,y,p\n", "# nothing\n\n"):
        for frame in (FRAME, None):
            assert "has no events" in refusal(text(content), frame_px=frame)


def test_a_line_without_end_is_refused(text: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a file without line breaks does not fill the memory."""
    monkeypatch.setattr(read_text, "BLOCK_CHARS", 1 << 16)
    assert "line 2 has more than" in refusal(text("0 1 2 1\n" + "1 " * 70000), frame_px=FRAME)


def test_sorting_is_offered_and_noted(text: Callable[..., Path]) -> None:
    """Assert that time that goes backwards is refused with a way out, which then says what it did."""
    jumbled = np.random.default_rng(0).permutation(4000) * 1000
    path = text("".join(f"{t} {t % 7} 2 1\n" for t in jumbled.tolist()))
    assert "--sort sorts all events by time" in refusal(path, frame_px=FRAME)
    imported = read_events(path, frame_px=FRAME, order=OrderOptions(sort=True))
    assert imported.events.t.tolist() == list(range(0, 4_000_000, 1000))
    back = np.maximum.accumulate(jumbled) - jumbled
    words = f"{np.count_nonzero(back):,} events came up to {back.max() / 1e6:.6g} s late"
    assert f"{words}: sorted" in imported.notes


def test_what_the_docs_tell_to_write_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the page's lines of Python and its command, and its text, give the two events that they show."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "recordings.md").read_text()
    monkeypatch.chdir(tmp_path)
    blocks = [re.sub("(?m)^    ", "", block) for block in re.findall(r"(?m)(?:^    .+\n)+", page)]
    exec(next(block for block in blocks if block.startswith("import numpy")))
    command = next(block for block in blocks if "touch.npz" in block and block.startswith("evetac")).split()
    params = Record(source=Path(command[command.index("--from") + 1]), frame_size="640x480")
    (row,) = run_stage(record, [], params, Path(command[command.index("--out") + 1]))[1].rows
    assert (row["events"], row["notes"]) == (2, None)
    (tmp_path / "a.txt").write_text(next(block for block in blocks if block.startswith("t_us x y p")))
    written = [(0, 312, 77, 1), (7, 313, 77, 0)]
    assert event_rows(read_events(tmp_path / "a.txt")) == event_rows(read_events(tmp_path / "touch.npz")) == written


def test_an_import_is_all_or_nothing(
    text: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a file that is refused at its end leaves nothing, and that one imported before is not made anew."""
    monkeypatch.setattr(source, "BLOCK_EVENTS", 3)
    lines = "".join(f"{1500 * number} {number % 9} 2 1\n" for number in range(10))

    def imported(content: str, folder: Path = tmp_path) -> Outcome:
        params = Record(source=text(content), frame_size="640x480")
        return run_stage(record, [], params, folder / "out.recording.h5")[1]

    for folder in (tmp_path, tmp_path / "new" / "folder"):
        with pytest.raises(InputError, match="line 11 from 0.013500 s to 0.000100 s"):
            imported(lines + "100 1 1 1\n", folder)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert imported(lines).made
    made = (tmp_path / "out.recording.h5").stat()
    assert not imported(lines).made
    again = (tmp_path / "out.recording.h5").stat()
    assert (again.st_ino, again.st_mtime_ns) == (made.st_ino, made.st_mtime_ns)
    with StageFile(tmp_path / "out.recording.h5") as file:
        assert file.read("events/t").tolist() == [1500 * number for number in range(10)]
        assert file.read("ms_to_idx").tolist() == slice_starts(file.read("events/t"), 14).tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "out.recording.h5"]


# --- files that are something else --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.txt", b"", "the file is empty"),
        ("a.h5", pickle.dumps({"t": [1]}), "never loads pickles"),
        ("a.aedat4", b"0 1 2 1\n", "begins with b'0 1 2 1"),
        ("a.txt", b"0 1 \x00\x00 2 1\n", "begins with b'0 1 "),
        ("a.aedat", b"#!AER-DAT3.1\r\n# x\r\n", "AEDAT of another version"),
        ("a.raw", b"% evt 4.1\n% end\n\x00\x01", "with Prophesee's tools"),
        ("a.npz", b"PK\x03\x04rest", "cannot be read as npy"),
        ("a.txt.gz", b"\x1f\x8b\x08rest", "gunzip"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfdrest", "the bag's folder"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "docs/recordings.md"),
        ("a.bag", b"#ROSBAG V1.2\n", "rosbag migrate"),
    ],
)
def test_strangers_are_named(text: Callable[..., Path], name: str, content: bytes, words: str) -> None:
    """Assert that a file of another kind is refused by its content, with a way on where there is one."""
    assert words in refusal(text(content, name), frame_px=FRAME)


def test_options_that_would_do_nothing_are_refused(text: Callable[..., Path], dsec: Callable[..., Path]) -> None:
    """Assert that an option of another format is an error."""
    assert "--stream is for files that may contain several" in refusal(
        text("0 1 2 1\n"), frame_px=FRAME, stream="events"
    )
    assert "only one stream" in refusal(dsec(), frame_px=FRAME, stream="events")


# --- HDF5 ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def dsec(tmp_path: Path) -> Callable[..., Path]:
    """Write an HDF5 file in the layout of DSEC; keywords replace single columns, None leaves one out."""

    def write(edit: Callable[[h5py.File], None] | None = None, options: Any = None, **given: Any) -> Path:
        path = tmp_path / "a.h5"
        arrays = {
            "t": np.array([1000, 2500, 3000], np.uint32),
            "x": np.array([1, 3, 5], np.uint16),
            "y": np.array([2, 4, 6], np.uint16),
            "p": np.array([1, 0, 1], np.uint8),
        } | given
        with h5py.File(path, "w") as file:
            file.create_group("events")
            for name, array in arrays.items():
                if array is not None:
                    file.create_dataset(f"events/{name}", data=array, **(options or {}))
            if edit:
                edit(file)
        return path

    return write


def test_dsec_layout_is_read(dsec: Callable[..., Path]) -> None:
    """Assert that events, clock and slices come out of the layout of DSEC."""

    def complete(file: h5py.File) -> None:
        file["t_offset"] = np.int64(49_599_000_000)
        file["ms_to_idx"] = np.array([0, 0, 1, 2], np.uint64)

    imported = read_events(dsec(complete), frame_px=FRAME)
    assert event_rows(imported) == ROWS
    assert (imported.format, imported.t_offset_us, imported.slices) == ("hdf5", 49_599_001_000, 3)
    assert read_events(dsec()).frame_px == (128, 128)


def test_hdf5_is_read_in_batches(dsec: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that batches join without loss, and places are counted through them."""
    monkeypatch.setattr("evetac_cli.formats.read.read_hdf5.BATCH_ROWS", 2)
    assert event_rows(read_events(dsec(), frame_px=FRAME)) == ROWS
    assert "at index 2 from" in refusal(dsec(t=np.array([5000, 6000, 4000])), frame_px=FRAME)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"x": np.array([1, 2], np.uint16)}, "columns differ in length"),
        ({"t": np.array([0.1, 0.2, 0.3])}, "in whole numbers, with times in us"),
        ({"p": np.array([b"+", b"-", b"+"])}, "`events/p`: |S1"),
    ],
)
def test_columns_that_do_not_fit_are_refused(dsec: Callable[..., Path], given: dict[str, Any], words: str) -> None:
    """Assert that odd columns are refused by name."""
    assert words in refusal(dsec(**given), frame_px=FRAME)


def test_other_layouts_are_refused_with_what_they_hold(tmp_path: Path) -> None:
    """Assert that HDF5 in the layout of other tools is told apart."""
    path = tmp_path / "a.h5"
    for name in ("images", "frames/left"):
        with h5py.File(path, "w") as file:
            file[name] = np.zeros((3, 4), np.uint32)
        assert f"found:    {name.split('/')[0]}" in refusal(path, frame_px=FRAME)
    with h5py.File(path, "w") as file:
        file.create_group(b"\xff")
        file.create_group("images")
    assert "found:    b'\\xff', images" in refusal(path, frame_px=FRAME)
    with h5py.File(path, "w"):
        pass
    assert "found:    nothing" in refusal(path, frame_px=FRAME)


def test_odd_t_offsets_are_refused(dsec: Callable[..., Path]) -> None:
    """Assert that the clock of the file must be one integer within range."""
    for value in (1.5, np.array([1, 2]), "noon", np.uint64(2**63)):
        assert "t_offset" in refusal(
            dsec(lambda file, v=value: file.create_dataset("t_offset", data=v)), frame_px=FRAME
        )


def test_compressed_with_a_plugin(tmp_path: Path) -> None:
    """Assert that Blosc, as in the DSEC data set, is read where hdf5plugin is installed, without being asked to."""
    if find_spec("hdf5plugin") is None:
        pytest.skip("hdf5plugin is not installed")
    path = tmp_path / "a.h5"
    writing = (
        f"import h5py, hdf5plugin, numpy as np; f = h5py.File({str(path)!r}, 'w'); rows = np.arange(5000)\n"
        "for n in 'txyp': f.create_dataset('events/' + n, data=rows if n == 't' else rows % 2, **hdf5plugin.Blosc())"
    )
    reading = f"from evetac_cli.formats.imports import read_events; e = read_events({str(path)!r}, frame_px=(640, 480))"
    for code in (writing, f"{reading}.events; assert e.size == 5000 and e.x.sum() == 2500"):
        # in processes of their own: a plugin that was loaded once stays, and another test needs it not to be there
        subprocess.run(
            [sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[2], timeout=PATIENCE_S
        )


def test_broken_hdf5_is_refused(dsec: Callable[..., Path], tmp_path: Path) -> None:
    """Assert that an HDF5 file cut anywhere, or with a damaged chunk, is refused and never half read."""
    noise = np.random.default_rng(5).integers(0, 400, 4000).astype(np.uint16)
    options = {"chunks": (500,), "compression": "gzip"}
    columns = {"t": np.arange(4000), "x": noise, "y": noise, "p": noise % 2}
    path = dsec(options=options, **columns)
    whole = path.read_bytes()
    assert read_events(path, frame_px=FRAME).events.size == 4000
    cut = tmp_path / "cut.h5"
    for length in range(8, len(whole), len(whole) // 25):
        cut.write_bytes(whole[:length])
        refusal(cut, frame_px=FRAME)
    with h5py.File(path) as file:
        chunk = file["events/x"].id.get_chunk_info(3)
    broken = bytearray(whole)
    broken[chunk.byte_offset + 20 : chunk.byte_offset + 60] = bytes(40)
    cut.write_bytes(broken)
    assert "its events cannot be read" in refusal(cut, frame_px=FRAME)


# --- recordings made by others ------------------------------------------------------------------------------------


def test_real_text(outside_file: Callable[[str], Path]) -> None:
    """Assert that a text file of a data set is read: 50,000 events in 0.17 s on a frame of 240 x 180."""
    path = outside_file("slider_depth_50k.txt")
    imported = read_events(path, frame_px=(240, 180))
    assert (imported.events.size, imported.slices, imported.t_offset_us) == (50_000, 171, 3811)
    assert sum(imported.counts.values()) == 0
    assert read_events(path, frame_px=(120, 180)).counts["out_of_frame"] > 0
