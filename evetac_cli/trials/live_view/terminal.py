"""A live view in characters, for a terminal: the figures, and below them the areas with more events than noise."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.trials.live_view.samples import Follower

COLUMNS, ROWS = 80, 30  # characters, which are twice as high as wide
SHADES = " .:-=+*#%@"
FULL = 1.0  # events per pixel for the darkest shade
LEAST_EVENTS = 6  # fewest events of a displayed character: noise events are scattered and single
NOISE_SPREADS = 4.0  # a displayed character has more events than the noise level by this many standard deviations


def screen(follower: Follower, sample: Mapping[str, Any], lost: str, messages: Sequence[str]) -> str:
    """Return the whole view: figures, events, and the last message."""
    x, y, _ = follower.latest()
    events = picture(x, y, follower.frame_px)
    lines = [headline(sample, lost), with_dots(events, follower.dots(), follower.frame_px)]
    return "\n".join([*lines, *follower.notes, *messages[-1:]])


def headline(sample: Mapping[str, Any], lost: str) -> str:
    """Return the figures of a sample, in one line of at most 80 characters."""

    def figure(name: str, form: str, words: str) -> list[str]:
        value = sample.get(name)
        return [] if value is None else [words.format(format(value, form))]

    parts = [
        *figure("t", ".1f", "{} s"),
        *figure("events_per_s", ",.0f", "{} events/s"),
        f"lost {lost}",
        *figure("late_most_ms", ".1f", "late {} ms"),
        *figure("probability", ".2f", "slip {}"),
        *figure("position_ticks", ".0f", "at {}"),
        *figure("current_ma", ".0f", "{} mA"),
    ]
    return "  ".join(parts)[:COLUMNS]


def with_dots(events: str, dots: Sequence[Sequence[float]], frame_px: tuple[int, int]) -> str:
    """Return the picture with an o at each dot, or an x if it is lost; dots: rows x, y, ..., lost."""
    lines = [list(line) for line in events.splitlines()]
    for x, y, *_, lost in dots:
        lines[int(y) * ROWS // frame_px[1]][int(x) * COLUMNS // frame_px[0]] = "x" if lost else "o"
    return "\n".join(map("".join, lines))


def picture(x: NDArray[Any], y: NDArray[Any], frame_px: tuple[int, int]) -> str:
    """Return events at x, y as ROWS lines of COLUMNS characters, darker for more; scattered ones are not shown."""
    width, height = frame_px
    place = y.astype(np.int64) * ROWS // height * COLUMNS + x.astype(np.int64) * COLUMNS // width
    counts = np.bincount(place, minlength=ROWS * COLUMNS)
    pixels = width * height / (ROWS * COLUMNS)
    dark = np.sqrt(np.minimum(counts / (FULL * pixels), 1.0))  # so that events of a single dot are visible too
    noise = float(np.median(counts))  # most characters have only noise
    dark[(counts < LEAST_EVENTS) | (counts <= noise + NOISE_SPREADS * np.sqrt(noise))] = 0.0
    shade = np.ceil(dark * (len(SHADES) - 1)).astype(np.int64).reshape(ROWS, COLUMNS)
    return "\n".join("".join(SHADES[value] for value in line) for line in shade)
