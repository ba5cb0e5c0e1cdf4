"""Alarms of a slip detector, or of an oracle, in one trial: which are false, and how far ahead of slip they come.

Alarms are those of kernels/slip/alarms.py. Two rules say what makes an alarm true, as some users want to know of
partial slip and others of gross slip:

- `partial`: SLIPS or more of the visible contact slips from BEFORE_MS before to AFTER_MS after it;
- `gross`: the object slides within FOLLOWS_MS after it.

A gross slip is warned of by the alarm that lasts until it, unless that alarm began as a false one. An alarm while the
object slides, LATE_MS and more after it began to, warns of nothing and is not counted.
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
    """Slices at which flags begin to be set after they were not for so long."""
    found: list[int] = []
    last = -apart_ms - 1
    for at in np.flatnonzero(flags).tolist():
        if at - last > apart_ms:
            found.append(at)
        last = at
    return found


def slip_begins(slips: Flags) -> list[int]:
    """Slices at which gross slip begins after APART_MS without any."""
    return begins(slips, APART_MS)


class Judged(NamedTuple):
    """Of one trial and threshold: false alarms by rule, and how far ahead each slip was warned of; None: it was not."""

    false: dict[str, int]
    leads_ms: dict[str, list[int | None]]


def judge(alarming: Flags, share: Singles, slips: Flags) -> Judged:
    """Judge the slices that alarm by the true share of the contact that slips, and by gross slip."""
    slips_at = slip_begins(slips)
    slides = slips.copy()  # long enough for an alarm to be late
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
    return Judged(false, leads)
