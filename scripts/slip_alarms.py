"""Alarms of a slip detector, or of an oracle, in one trial: which are false, and how far ahead of slip they come.

An alarm begins where a score is at or above a threshold for IN_A_ROW slices, and ends once it has been below for
APART_MS. Two rules say which alarms are false, as some users want to know of incipient slip and others of gross slip:

- `unmoved`: less than SLIPS of the visible contact slips from BEFORE_MS before its begin to AFTER_MS after;
- `unfollowed`: no gross slip within FOLLOWS_MS after its begin.

A gross slip is warned of by the last alarm that is no false one by a rule and began before it or up to LATE_MS after;
an alarm that begins while the object slides warns of nothing and is not counted.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Singles

IN_A_ROW, APART_MS = 3, 200
SLIPS, BEFORE_MS, AFTER_MS = 0.3, 20, 60
FOLLOWS_MS, LATE_MS = 200, 20
RULES = ("unmoved", "unfollowed")
LEADS_MS = (0, 5, 10, 20, 40)


def begins(on: Flags) -> list[int]:
    """Slices at which alarms begin: IN_A_ROW slices on end are on, after APART_MS without any alarm."""
    streak = on.copy()
    for back in range(1, IN_A_ROW):
        streak[back:] &= on[:-back]
        streak[:back] = False
    found: list[int] = []
    last = -APART_MS - 1
    for at in np.flatnonzero(streak).tolist():
        if at - last > APART_MS:
            found.append(at)
        last = at
    return found


def slip_begins(slips: Flags) -> list[int]:
    """Slices at which gross slip begins after APART_MS without any."""
    found: list[int] = []
    last = -APART_MS - 1
    for at in np.flatnonzero(slips).tolist():
        if at - last > APART_MS:
            found.append(at)
        last = at
    return found


class Judged(NamedTuple):
    """Of one trial and threshold: false alarms by rule, and how far ahead each slip was warned of; None: it was not."""

    false: dict[str, int]
    leads_ms: dict[str, list[int | None]]


def judge(on: Flags, share: Singles, slips: Flags) -> Judged:
    """Judge where a score was at or above a threshold, by the true share of the contact that slips and gross slip."""
    alarms, onsets = begins(on), slip_begins(slips)
    false = dict.fromkeys(RULES, 0)
    true: dict[str, list[int]] = {rule: [] for rule in RULES}
    for at in alarms:
        if slips[at] and at - max((onset for onset in onsets if onset <= at), default=at) > LATE_MS:
            continue  # the object slides, and nobody was warned: no alarm is early or false here
        moves = bool((share[max(at - BEFORE_MS, 0) : at + AFTER_MS + 1] >= SLIPS).any())
        followed = bool(slips[max(at - LATE_MS, 0) : at + FOLLOWS_MS + 1].any())
        for rule, is_true in (("unmoved", moves), ("unfollowed", followed)):
            if is_true:
                true[rule].append(at)
            else:
                false[rule] += 1
    leads: dict[str, list[int | None]] = {rule: [] for rule in RULES}
    for rule in RULES:
        for number, onset in enumerate(onsets):
            since = onsets[number - 1] if number else -1
            warned = [at for at in true[rule] if since < at <= onset + LATE_MS]
            leads[rule].append(onset - warned[-1] if warned and _lasts(on, warned[-1], onset) else None)
    return Judged(false, leads)


def _lasts(on: Flags, begin: int, onset: int) -> bool:
    """Whether an alarm is still on at a slip: it has not been below the threshold for APART_MS since it began."""
    until = np.flatnonzero(on[begin : max(onset, begin) + 1])
    return bool(len(until)) and max(onset, begin) - (begin + int(until[-1])) <= APART_MS
