"""Classify the alarms of a slip detector, or of an oracle, in one trial: which are false, and how early they are.

Alarms are those of kernels/slip/alarms.py. Two rules define a true alarm, for users who want to know of partial slip
and users who want to know of gross slip:

- `partial`: SLIPS or more of the visible contact slips between BEFORE_MS before and AFTER_MS after the alarm;
- `gross`: the object slides within FOLLOWS_MS after the alarm.

The warning of a gross slip is the alarm that is on when it begins, unless that alarm began as a false one. An alarm
that begins while the object has been sliding for LATE_MS or more is not a warning and is not counted.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Singles
from evetac_cli.kernels.slip import alarms
from evetac_cli.kernels.slip.alarms import APART_MS

SLIPS, BEFORE_MS, AFTER_MS = 0.3, 20, 60
FOLLOWS_MS, LATE_MS = 200, 20
RULES = ("partial", "gross")


def begins(flags: Flags, apart_ms: int) -> list[int]:
    """Return the slices at which flags become set after a pause of a given length."""
    found: list[int] = []
    last = -apart_ms - 1
    for at in np.flatnonzero(flags).tolist():
        if at - last > apart_ms:
            found.append(at)
        last = at
    return found


def slip_begins(slips: Flags) -> list[int]:
    """Return the slices at which gross slip begins after APART_MS without any."""
    return begins(slips, APART_MS)


class AlarmCounts(NamedTuple):
    """Results of a trial at one threshold: false alarms by rule, and how early each slip was warned of (None: not)."""

    false: dict[str, int]
    leads_ms: dict[str, list[int | None]]


def judge(alarming: Flags, share: Singles, slips: Flags) -> AlarmCounts:
    """Classify alarms by the true slipping share of the contact and by gross slip."""
    slips_at = slip_begins(slips)
    slides = slips.copy()  # slices at which an alarm would be late
    for begin in slips_at:
        slides[begin : begin + LATE_MS + 1] = False

    def truths(at: int) -> dict[str, bool]:
        partial = bool((share[max(at - BEFORE_MS, 0) : at + AFTER_MS + 1] >= SLIPS).any())
        gross = bool(slips[max(at - LATE_MS, 0) : at + FOLLOWS_MS + 1].any())
        return {"partial": partial, "gross": gross}

    false = dict.fromkeys(RULES, 0)
    for at in alarms.onsets(alarming & ~slides).tolist():
        for rule, is_true in truths(at).items():
            false[rule] += not is_true
    leads: dict[str, list[int | None]] = {rule: [] for rule in RULES}
    for begin in slips_at:
        lead = alarms.lead_ms(alarming, begin)
        first = None if lead is None or lead < -LATE_MS else truths(begin - lead)
        for rule in RULES:
            leads[rule].append(lead if first is not None and first[rule] else None)
    return AlarmCounts(false, leads)
