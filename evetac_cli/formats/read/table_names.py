"""Find the columns of times of a table by their names, and the unit that the name of any column states.

A table may have several times: a program's own, the stamp of a message (`header.stamp`), and the time at which another
program received the message (`%time` of rostopic, `__time` of PlotJuggler). A name that states its unit is preferred,
then a stamp, then any other; a time of reception is the last resort.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from evetac_cli.errors import InputError

TICKS_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # ticks per second of each unit of time
SPOKEN_UNITS = {
    **{name: "s" for name in ("s", "sec", "secs", "second", "seconds")},
    **{name: "ms" for name in ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds")},
    **{name: "us" for name in ("us", "usec", "usecs", "\u00b5s", "\u03bcs", "micros", "microsecond", "microseconds")},
    **{name: "ns" for name in ("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds")},
}
OWN = r"(?:(?:.*[/.])?(?:field[._])?header[._/](?:t|time|timestamp|stamp)|stamp)"
RECEIVED = r"_+|ros(?:bag)?_?|log_?|rec(?:v|eived?|eption|ord(?:ed)?)_?|arrival_?"
TIME = re.compile(
    rf"(?:(?P<stamp>{OWN})|(?:(?P<received>{RECEIVED})|msg_?)?(?:t|time|timestamp|stamp))"
    rf"(?:[_ ](?P<unit>{'|'.join(SPOKEN_UNITS)}))?"
)
PARTS = re.compile(r"(?P<whole>(?:.*[._/])?stamp)[._/](?P<part>secs?|nanosecs?|nsecs?)")
BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]{1,20})[\])]")
INDEX = re.compile(r"\s*[\[(]\s*([-+]?\d[\d\s,;:.]*|[xyzw])\s*[\])]")  # of an element: q[0], pose[0][1], force[x]
# Units that a name may end in, for example `force_n`.
ENDINGS = {"m": "m", "mm": "mm", "rad": "rad", "deg": "deg", "n": "N", "nm": "N m", "ma": "mA", "hz": "Hz", "pa": "Pa"}
NAMES = "t_us, t_ms, t_s, t_ns, timestamp, time, stamp or header.stamp"


class Times(NamedTuple):
    """The columns of a table's times: one, or two for seconds and nanoseconds; the unit, if known; the other times."""

    columns: tuple[int, ...]
    unit: str
    clock: str
    others: tuple[int, ...] = ()


class _Candidate(NamedTuple):
    """Times that could be chosen; the least is preferred."""

    is_unusable: bool
    is_received: bool
    lacks_unit: bool
    is_no_stamp: bool
    columns: tuple[int, ...]
    unit: str


def find_times(names: Sequence[str], types: Sequence[Any], where: str) -> Times:
    """Return the columns of times, found by name, or by a type that is a time; raise InputError if there are none."""
    plain = [name_and_unit(name) for name in names]
    candidates = []
    parts: dict[str, dict[str, int]] = {}
    for at, (name, in_brackets) in enumerate(plain):
        if match := TIME.fullmatch(name.lower()):
            unit = SPOKEN_UNITS.get(match["unit"] or in_brackets.lower(), "")
            received = bool(match["received"]) or names[at].strip().startswith("%")
            candidates.append(_Candidate(not is_time(types[at]), received, not unit, not match["stamp"], (at,), unit))
        elif match := PARTS.fullmatch(name.lower()):
            parts.setdefault(match["whole"], {})[match["part"][0]] = at
    candidates += [
        _Candidate(False, False, True, False, (pair["s"], pair["n"]), "ns") for pair in parts.values() if len(pair) == 2
    ]
    of_topics = [one for one in candidates if not one.is_no_stamp and "/" in plain[one.columns[0]][0]]
    if len(of_topics) > 1:  # PlotJuggler joins several topics; the stamp of one is empty in the rows of the others
        candidates = [one._replace(is_unusable=one.is_unusable or one in of_topics) for one in candidates]
    candidates = candidates or [
        _Candidate(False, False, False, True, (at,), "") for at, kind in enumerate(types) if has_unit(kind)
    ]
    if not candidates:
        expected, found = f"a column named {NAMES}", ", ".join(names)[:200]
        raise InputError("the table has no column of times", where=where, expected=expected, found=found)
    best = min(candidates)
    clock = " and ".join(plain[at][0] for at in best.columns) or "without a name"
    stated = f", in {best.unit}" if best.unit and len(best.columns) == 1 else ""
    others = [at for one in candidates for at in one.columns if at not in best.columns]
    return Times(best.columns, best.unit, f"column {clock}{stated}", tuple(others))


def is_time(kind: Any) -> bool:
    """Whether a column of an Arrow type can be a time."""
    from pyarrow import types

    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_null(kind) or has_unit(kind))


def has_unit(kind: Any) -> bool:
    """Whether an Arrow type is a time that states its unit: a date with time, a duration, or a time of day."""
    from pyarrow import types

    return bool(types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind))


def name_and_unit(name: str) -> tuple[str, str]:
    """Return the name of a column without a unit in brackets, and its unit, if the name states it.

    A number in brackets, or the letter of an axis, is the index of an element: it stays in the name, `q[0]` as `q_0`.
    """
    plain = name.strip().lstrip("%#").strip()
    indexed = INDEX.sub(lambda match: "_" + "_".join(re.findall(r"[-\w.]+", match[1])), plain)
    if match := BRACKETS.fullmatch(indexed):
        return match["name"].rstrip(" ,"), match["unit"].strip()
    without = INDEX.sub("", plain).lower()
    return indexed, ENDINGS.get(without.rpartition("_")[2], "") if "_" in without else ""
