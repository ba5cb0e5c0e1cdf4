"""Event words of the DVXplorer Mini: the maker's vectors, round trips, any cut, and what is left after damage."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer import event_words
from evetac_cli.devices.dvxplorer.event_word_loops import REFUSED_IN_A_ROW
from evetac_cli.events import Events, concatenate

# Hardware notes, 3.1: words and what the maker's parser (dv-processing 2.0.4) makes of them.
VECTOR = bytes.fromhex(
    "05000008 64d02704 81022a8c 65d00704 8000ed80 00000000 06000008 00002004 01000080 7f020004 ff1004fc"
)
VECTOR_EVENTS = [
    *((5250, 100, 80, 1), (5250, 100, 87, 1), (5250, 100, 105, 0), (5250, 101, 479, 0), (6000, 0, 0, 1)),
    *((6000, 639, y, 1) for y in range(8, 16)),
    (6000, 639, 260, 1),
]


def stamp(ms: int) -> int:
    return 2 << 26 | ms & 0x3FFFFF


def column(x: int, us: int, begins: bool = False) -> int:
    return 1 << 26 | begins << 21 | us << 11 | x


def group(
    first: int, bits: int, darker: bool = False, row_offset: int = 0, bits2: int = 0, darker2: bool = False
) -> int:
    return 1 << 31 | row_offset << 26 | first << 18 | darker2 << 17 | darker << 16 | bits2 << 8 | bits


def decoded(words: Iterable[int], host_ms: int | None = None) -> tuple[list[tuple[int, ...]], dict[str, int]]:
    """All events of a stream, and what was lost, but for zeros."""
    decoder = event_words.start()
    events = event_words.step(decoder, np.array(list(words), "<u4").tobytes(), host_ms)
    return rows(concatenate([events, event_words.flush(decoder)])), lost(decoder)


def lost(decoder: event_words.EventWordDecoder) -> dict[str, int]:
    return {name: count for name, count in decoder.counted.items() if count}


def rows(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(column.tolist() for column in events), strict=True))


def in_order(events: Events) -> Events:
    """The same events, by time, column, row and polarity."""
    order = np.lexsort((events.p, events.y, events.x, events.t))
    return Events(events.t[order], events.x[order], events.y[order], events.p[order])


def equal(one: Events, other: Events) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(in_order(one), in_order(other), strict=True))


def frames(rng: np.random.Generator, count: int, period_us: int = 200, events: int = 40) -> Events:
    """Events that frames can hold: no pixel twice, one polarity in a frame."""
    t, x, y, p = [], [], [], []
    for frame in range(count):
        pixels = rng.choice(640 * 480, events, replace=False)
        t.append(np.full(events, frame * period_us))
        x.append(pixels % 640)
        y.append(pixels // 640)
        p.append(np.full(events, rng.integers(2)))
    columns = (np.concatenate(each) for each in (t, x, y, p))
    return Events(
        *(each.astype(kind) for each, kind in zip(columns, (np.int64, np.uint16, np.uint16, np.uint8), strict=True))
    )


def whole(words: NDArray[np.uint32]) -> tuple[Events, event_words.EventWordDecoder]:
    decoder = event_words.start()
    events = event_words.step(decoder, words.astype("<u4").tobytes())
    return concatenate([events, event_words.flush(decoder)]), decoder


def test_vector_of_the_document() -> None:
    """Assert that the document's words give exactly its 14 events, in order, with nothing lost."""
    decoder = event_words.start()
    events = concatenate([event_words.step(decoder, VECTOR), event_words.flush(decoder)])
    assert rows(events) == VECTOR_EVENTS
    assert [each.dtype for each in events] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert lost(decoder) == {}


def test_what_the_makers_parser_made(outside_file: Callable[[str], Path]) -> None:
    """Assert the maker's 70,789 events, as sets per time and column; its parser keeps back the last interval."""
    with np.load(outside_file("dvxplorer_mini_words.npz")) as made:
        expected = Events(made["t_us"], made["x"], made["y"], made["p"])
        events, decoder = whole(made["words"])
    given_out = events.t <= expected.t[-1]
    assert given_out.sum() == 70_789
    assert equal(Events(*(each[given_out] for each in events)), expected)
    assert lost(decoder) == {}


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_round_trip_in_any_cut(data: st.DataObject) -> None:
    """Assert that decode(encode(e)) is e for events that frames can hold, wherever the bytes are cut."""
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    first_ms = data.draw(st.sampled_from([0, 1, 77, 2**22 - 3]))
    events = frames(rng, data.draw(st.integers(1, 30)), data.draw(st.sampled_from([1, 66, 200, 1000, 7000])))
    stream = event_words.encode(events, first_ms).astype("<u4").tobytes()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    decoder = event_words.start()
    bounds = [0, *cuts, len(stream)]
    parts = [event_words.step(decoder, stream[a:b]) for a, b in zip(bounds, bounds[1:], strict=False)]
    back = concatenate([*parts, event_words.flush(decoder)])
    assert equal(back._replace(t=back.t - 1000 * first_ms), events)
    assert (np.diff(back.t) >= 0).all()
    assert ((np.diff(back.t) > 0) | (np.diff(back.x.astype(int)) >= 0)).all()
    assert lost(decoder) == {}


def test_encoder_obeys_the_rules() -> None:
    """Assert the rules of the stream on encoded words, by a reader that knows nothing of the decoder."""
    rng = np.random.default_rng(3)
    count = 5000
    events = Events(
        np.sort(rng.integers(0, 20_000, count)),
        rng.integers(0, 40, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )
    ms = us = x = -1
    seen: set[int] = set()
    fired = 0
    for word in event_words.encode(events, 1, 200).tolist():
        if word >> 31:
            first = word >> 18 & 63
            groups = [first] + ([first + (word >> 26 & 31)] if word >> 8 & 0xFF else [])
            assert max(groups) < 60
            assert not seen & set(groups)
            assert len(groups) == len(set(groups))
            assert word & 0xFF
            seen |= set(groups)
            fired += (word & 0xFFFF).bit_count()
        elif word >> 26 == 2:
            assert word & 0x3FFFFF > ms
            ms, us = word & 0x3FFFFF, -1
        else:
            assert word >> 26 == 1
            assert (word >> 21 & 1) == ((word >> 11 & 0x3FF) != us)
            if word >> 21 & 1:
                assert us < (word >> 11 & 0x3FF) < 1000
                us, x = word >> 11 & 0x3FF, -1
            assert x < (word & 0x3FF) < 640
            x = word & 0x3FF
            seen = set()
    assert fired == count


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 200, 333, 1000]))
@settings(max_examples=30, deadline=None)
def test_nothing_is_lost_that_frames_cannot_hold(seed: int, frame_us: int) -> None:
    """Assert that pixels that fire twice, or both ways, keep every event, its pixel and its slice."""
    rng = np.random.default_rng(seed)
    count = 600
    events = Events(
        np.sort(rng.choice([0, 1, 998, 999, 1000, 1999, 5000], count)).astype(np.int64),
        rng.integers(0, 3, count).astype(np.uint16),
        rng.integers(0, 9, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )
    back, decoder = whole(event_words.encode(events, 0, frame_us))
    slices = [each._replace(t=each.t // 1000) for each in (back, events)]
    assert equal(*slices)
    assert lost(decoder) == {}


def test_encode_refuses_what_has_no_room() -> None:
    """Assert a ValueError for more events of a pixel than a millisecond holds, and no words for no events."""
    one = Events(np.array([5]), *(np.array([0], kind) for kind in (np.uint16, np.uint16, np.uint8)))
    assert len(event_words.encode(one.part(0, 0))) == 0
    twice = Events(*(np.repeat(each, 1001) for each in one))
    with pytest.raises(ValueError, match="at most 1000"):
        event_words.encode(twice)


def test_milliseconds_wrap() -> None:
    """Assert that time goes on where the 22 bits end, again and again."""
    words = []
    for turn in range(3):
        for ms in (0x3FFFFE, 0x3FFFFF, 0, 1, 0x200000):
            words += [stamp(ms), column(7, 10, True), group(0, 1, darker=turn == 1)]
    events, missing = decoded(words)
    first = 0x3FFFFE
    expected = [first + d + turn * 2**22 for turn in range(3) for d in (0, 1, 2, 3, 0x200002)]
    assert [row[0] for row in events] == [1000 * ms + 10 for ms in expected]
    assert missing == {"ms_without_time": expected[-1] - expected[0] - 9}


GOOD = [stamp(3), column(5, 100, True), group(1, 1)]  # frame before the damage
SAME_MS = [column(6, 700, True), group(2, 1)]
NEXT_MS = [stamp(4), column(7, 100, True), group(3, 1)]
KEPT = (3100, 5, 8, 1)
KEPT_SAME_MS = (3700, 6, 16, 1)
KEPT_NEXT_MS = (4100, 7, 24, 1)

# Words of a damaged frame behind a good one; reason counted; events lost, but for those of words beside one that no
# camera sends, whose bits say nothing; whether the rest of the ms is believed.
DAMAGE = {
    "unknown code": ([column(9, 300, True), group(0, 7), 0x7FFFFFFF], "unknown_words", 3, False),
    "unknown word between frames": ([0x0C000000], "unknown_words", 1, False),  # ends the good frame too
    "time stands still": ([column(9, 100, True), group(0, 7)], "missing_words", 3, False),
    "time goes back": ([column(9, 50, True), group(0, 7)], "missing_words", 3, False),
    "another time within a frame": (
        [column(9, 300, True), group(0, 7), column(10, 301), group(0, 1)],
        *("missing_words", 4, False),
    ),
    "columns go back": ([column(9, 300, True), group(0, 7), column(8, 300), group(0, 1)], "missing_words", 4, False),
    "column twice": ([column(9, 300, True), group(0, 7), column(9, 300), group(0, 1)], "missing_words", 4, False),
    "column outside": ([column(640, 300, True), group(0, 7)], "outside_frame", 0, True),
    "later column outside": (
        [column(9, 300, True), group(0, 7), column(1023, 300), group(0, 1)],
        *("outside_frame", 3, True),
    ),
    "time outside": ([column(9, 1000, True), group(0, 7)], "outside_frame", 0, True),
    "group outside": ([column(9, 300, True), group(0, 7), group(60, 1)], "outside_frame", 3, True),
    "second group outside": (
        [column(9, 300, True), group(0, 7), group(40, 1, row_offset=20, bits2=1)],
        *("outside_frame", 3, True),
    ),
    "rows twice": ([column(9, 300, True), group(4, 7), group(4, 1)], "repeated_rows", 3, False),
    "rows twice in a word": ([column(9, 300, True), group(4, 7, row_offset=0, bits2=1)], "repeated_rows", 0, False),
    "rows again as second": (
        [column(9, 300, True), group(9, 7), group(4, 1, row_offset=5, bits2=1)],
        "repeated_rows",
        3,
        False,
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_costs_its_frame(name: str) -> None:
    """Assert what is dropped and counted after each kind of damage, and that the next millisecond is whole again."""
    damaged, reason, events_lost, same_ms = DAMAGE[name]
    events, missing = decoded([*GOOD, *damaged, *SAME_MS, *NEXT_MS])
    chosen = [] if name == "unknown word between frames" else [KEPT]
    assert events == [*chosen, *([KEPT_SAME_MS] if same_ms else []), KEPT_NEXT_MS]
    assert missing.pop(reason) == 1
    assert missing.pop("events_in_dropped_frames", 0) == events_lost + (0 if same_ms else 1)
    assert missing == {}


def test_words_before_the_first_timestamp() -> None:
    """Assert that a stream that begins in the middle is believed from its first TIMESTAMP on."""
    events, missing = decoded([group(5, 3), *SAME_MS, *NEXT_MS])
    assert events == [KEPT_NEXT_MS]
    assert missing == {"events_before_first_timestamp": 3}


@pytest.mark.parametrize("frame", [[column(9, 100), group(0, 7)], [group(0, 7)]])
def test_frame_without_its_beginning(frame: list[int]) -> None:
    """Assert that after a TIMESTAMP only a column with SOF begins a frame; what else comes is not trusted."""
    events, missing = decoded([stamp(3), *frame, *SAME_MS, *NEXT_MS])
    assert events == [KEPT_NEXT_MS]
    assert missing == {"missing_words": 1, "events_in_dropped_frames": 4}


def test_padding_and_unused_bits() -> None:
    """Assert that zeros and the bits without a meaning change nothing."""
    plain, _ = decoded([*GOOD, *SAME_MS, *NEXT_MS])
    noisy = [0, GOOD[0] | 0x03C00000, 0, GOOD[1] | 1 << 10, GOOD[2] | 0x03000000, 0, 0, *SAME_MS, *NEXT_MS, 0]
    assert decoded(noisy) == (plain, {})


def test_timestamp_far_ahead_needs_the_hosts_clock() -> None:
    """Assert that a damaged TIMESTAMP costs its millisecond, and that a long silence is counted as such."""
    later = [stamp(5), column(8, 100, True), group(0, 1)]
    damaged = [stamp(4 | 1 << 18), *NEXT_MS[1:]]
    events, missing = decoded([*GOOD, *damaged, *later], host_ms=6)
    assert events == [KEPT, (5100, 8, 0, 1)]
    assert missing == {"refused_timestamps": 1, "events_in_dropped_frames": 1}
    silence_ms = 1 << 18
    events, missing = decoded([*GOOD, stamp(silence_ms), *NEXT_MS[1:]], host_ms=silence_ms)
    assert [row[0] for row in events] == [3100, 1000 * silence_ms + 100]
    assert missing == {"ms_without_time": silence_ms - 3}
    events, missing = decoded([*GOOD, stamp(90), *NEXT_MS[1:]], host_ms=0)
    assert [row[0] for row in events] == [3100, 90_100]
    assert missing == {}


def test_no_timestamp_is_believed_beyond_the_hosts_time() -> None:
    """Assert that small steps, too, go no further than can have passed since the first TIMESTAMP."""
    words = [word for ms in range(1, 40, 2) for word in (stamp(ms), column(1, 0, True), group(0, 1))]
    decoder = event_words.start()
    events = event_words.step(decoder, np.array([*words, stamp(41)], "<u4").tobytes(), 1, 20)
    assert events.t.tolist() == [1000 * ms for ms in range(1, 22, 2)]
    assert lost(decoder) == {"refused_timestamps": 10, "events_in_dropped_frames": 9}


def test_damaged_timestamps_now_and_then_are_no_new_clock() -> None:
    """Assert that only refusals in a row speak of a new clock."""
    words = [stamp(1)]
    for ms in range(2, 2 + 2 * REFUSED_IN_A_ROW):
        words += [stamp(ms ^ 1 << 21), stamp(ms), column(1, 0, True), group(0, 1)]
    events, missing = decoded(words, host_ms=100)
    assert [row[0] for row in events] == [1000 * ms for ms in range(2, 2 + 2 * REFUSED_IN_A_ROW)]
    assert missing == {"refused_timestamps": 2 * REFUSED_IN_A_ROW}


@pytest.mark.parametrize("host_ms", [None, 5000])
def test_clock_that_starts_anew(host_ms: int | None) -> None:
    """Assert that a camera whose clock is set back is believed after some refusals, and time never goes back.

    That the host is further on means that this program was late, not that the camera was silent.
    """
    words = [stamp(4000), column(1, 0, True), group(0, 1)]
    for ms in range(40):
        words += [stamp(ms), column(1, 0, True), group(0, 1)]
    events, missing = decoded(words, host_ms)
    left = 40 - REFUSED_IN_A_ROW + 1
    began_ms = 4001 if host_ms is None else host_ms
    assert [row[0] for row in events] == [4_000_000, *(1000 * (began_ms + k) for k in range(left))]
    assert missing == {
        "refused_timestamps": REFUSED_IN_A_ROW,
        "clock_restarts": 1,
        "events_in_dropped_frames": REFUSED_IN_A_ROW - 1,
    }


def test_flush_gives_the_open_frame_once() -> None:
    """Assert that a flushed frame may go on, and that every event comes once."""
    decoder = event_words.start()
    assert event_words.step(decoder, np.array(GOOD, "<u4").tobytes()).size == 0
    assert rows(event_words.flush(decoder)) == [KEPT]
    assert event_words.flush(decoder).size == 0
    more = event_words.step(decoder, np.array([column(6, 100), group(0, 1), *NEXT_MS], "<u4").tobytes())
    assert rows(more) == [(3100, 6, 0, 1)]
    assert rows(event_words.flush(decoder)) == [KEPT_NEXT_MS]
    assert lost(decoder) == {}


def test_timestamp_completes() -> None:
    """Assert that a TIMESTAMP alone gives out the frame before it."""
    decoder = event_words.start()
    event_words.step(decoder, np.array(GOOD, "<u4").tobytes())
    assert rows(event_words.step(decoder, event_words.timestamp(4).tobytes())) == [KEPT]
    assert decoder.now_us == 4000
    assert decoder.first_ms == 3


def test_lost_bytes_end_trust_until_the_next_timestamp() -> None:
    """Assert that after bytes_were_lost the open frame and a split word go, and the next TIMESTAMP is believed."""
    decoder = event_words.start()
    event_words.step(decoder, np.array(GOOD, "<u4").tobytes() + b"\x01\x02")
    event_words.bytes_were_lost(decoder)
    events = event_words.step(decoder, np.array([*SAME_MS, *NEXT_MS], "<u4").tobytes())
    assert rows(concatenate([events, event_words.flush(decoder)])) == [KEPT_NEXT_MS]
    assert lost(decoder) == {"events_in_dropped_frames": 2, "torn_bytes": 2}


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(16, 400))
@settings(max_examples=60, deadline=None)
def test_torn_transfer(seed: int, torn: int, size: int) -> None:
    """Assert that a transfer whose last bytes are missing costs at most the millisecond it is in and the next."""
    rng = np.random.default_rng(seed)
    events = frames(rng, 100, 200, 20)
    stream = event_words.encode(events, 1).astype("<u4").tobytes()
    blocks = [stream[k : k + 4 * size] for k in range(0, len(stream), 4 * size)]
    hit = int(rng.integers(len(blocks)))
    words = np.frombuffer(b"".join(blocks[:hit]), "<u4")
    stamps = words[words >> 26 == 2]
    at_ms = int(stamps[-1] & 0x3FFFFF) if len(stamps) else 1
    blocks[hit] = blocks[hit][:-torn]
    ends_ms = max(
        at_ms,
        *(int(word & 0x3FFFFF) for word in np.frombuffer(stream[: 4 * size * (hit + 1)], "<u4") if word >> 26 == 2),
    )
    decoder = event_words.start()
    parts = [event_words.step(decoder, block) for block in blocks]
    back = concatenate([*parts, event_words.flush(decoder)])
    back = back._replace(t=back.t - 1000)
    before = 1000 * (at_ms - 2)
    after = 1000 * (ends_ms + 2)
    for chosen in (lambda t: t < before, lambda t: t >= after):
        assert equal(*(Events(*(each[chosen(e.t)] for each in e)) for e in (back, events)))
    assert back.size + decoder.counted["events_in_dropped_frames"] <= events.size + 16


@given(st.binary(max_size=4000), st.sampled_from([None, 250, 10**6]), st.integers(1, 97))
@settings(max_examples=150, deadline=None)
def test_garbage(garbage: bytes, host_ms: int | None, size: int) -> None:
    """Assert that whatever comes, events lie in the frame, time does not go back, and a good stream is found again."""
    decoder = event_words.start()
    parts = [event_words.step(decoder, garbage[k : k + size], host_ms) for k in range(0, len(garbage), size)]
    good = frames(np.random.default_rng(1), 200, 200, 10)
    stream = event_words.encode(good, 1).astype("<u4").tobytes()
    parts += [event_words.step(decoder, stream[k : k + 400], host_ms) for k in range(0, len(stream), 400)]
    events = concatenate([*parts, event_words.flush(decoder)])
    assert (np.diff(events.t) >= 0).all()
    assert (events.x < 640).all()
    assert (events.y < 480).all()
    assert (events.p <= 1).all()
    tail = good.size - 50 * (REFUSED_IN_A_ROW + 2)
    assert all(
        np.array_equal(a[-tail:], b[-tail:]) for a, b in list(zip(in_order(events), in_order(good), strict=True))[1:]
    )
    assert np.array_equal(np.diff(in_order(events).t[-tail:]), np.diff(in_order(good).t[-tail:]))
