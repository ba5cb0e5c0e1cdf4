"""Estimates from a rest: the noise of the camera, from the longest time in which nothing moves."""

from dataclasses import dataclass

import numpy as np

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.calibration import rest_image
from evetac_cli.kernels.identify import rest
from evetac_cli.kernels.identify.rest import RestNoise
from evetac_cli.stages.identify.sensor_text import Entry, EstimateRow
from evetac_cli.store.recordings.read import Recording

SHORTEST_REST = 500  # slices
LONGEST_REST = 60_000  # slices that are used
MOST_EVENTS = 20_000_000  # events that are used
MAKE_REST = "cannot be estimated from these recordings: make one of 3 s or more in which nothing touches the gel"
MAKE_HOT = "cannot be estimated from these recordings: make a longer one in which nothing touches the gel"


@dataclass(frozen=True)
class Rest:
    """The longest rest of a recording: its noise, and its source."""

    noise: RestNoise
    source: str


def longest(recording: Recording, rng: np.random.Generator) -> Rest | None:
    """Return the noise in the longest time at rest; None if the recording has no rest of SHORTEST_REST."""
    spells = rest_image.quiet_spells(np.diff(recording.starts))
    first, stop = max(spells, key=lambda spell: spell[1] - spell[0], default=(0, 0))
    stop = min(stop, first + LONGEST_REST)
    most = int(np.searchsorted(recording.starts, recording.starts[first] + MOST_EVENTS, side="right")) - 1
    stop = min(stop, most)
    if stop - first < SHORTEST_REST:
        return None
    events = recording.between(first, stop)
    columns = (events.t - SLICE_US * first, events.x, events.y, events.p)
    try:
        noise = rest.analyse(*columns, recording.frame_px, SLICE_US * (stop - first), rng)
    except ValueError:  # too many pixels are busy for a rest
        return None
    return Rest(noise, f"{recording.path.name}, {first} to {stop} ms")


def rows(resting: Rest | None) -> tuple[list[EstimateRow], dict[str, Entry]]:
    """Return rows and keys of the camera's noise."""
    units = {
        "noise_hz": "Hz a pixel",
        "noise_on_share": "",
        "hot pixels above 20 Hz": "",
        "events of hot pixels": "Hz",
        "ON share of hot pixels": "",
        "hot_pixel_table.dead_time_us": "us",
        "timestamp_step_us": "us",
    }
    if resting is None:
        return [EstimateRow(name, unit, None, MAKE_REST) for name, unit in units.items()], {}
    noise = resting.noise
    estimates = (
        noise.noise_hz,
        noise.noise_on_share if np.isfinite(noise.noise_on_share.value) else None,
        noise.hot_pixels,
        noise.hot_total_hz,
        noise.hot_on_share if np.isfinite(noise.hot_on_share.value) else None,
        noise.dead_time_us,
        noise.timestamp_step_us,
    )
    listed_rows = [
        EstimateRow(name, unit, estimate, MAKE_HOT if estimate is None else resting.source)
        for (name, unit), estimate in zip(units.items(), estimates, strict=True)
    ]
    values = {"noise_hz": Entry(noise.noise_hz.value, noise.noise_hz, resting.source)}
    if np.isfinite(noise.noise_on_share.value):
        values["noise_on_share"] = Entry(noise.noise_on_share.value, noise.noise_on_share, resting.source)
    if noise.timestamp_step_us is not None:
        values["timestamp_step_us"] = Entry(noise.timestamp_step_us.value, noise.timestamp_step_us, resting.source)
    values["hot_pixels"] = Entry(0, None, f"{resting.source}: all hot pixels are in the table")
    listed = noise.table
    if len(listed.x_px):
        half = np.median((listed.high_hz - listed.low_hz) / 2 / listed.rate_hz)
        about = f"{resting.source}: {len(listed.x_px)} above {rest.HOT_HZ:g} Hz; rates within {half:.0%} (median, 95 %)"
        dead_us = 0.0 if noise.dead_time_us is None else noise.dead_time_us.value
        columns = {name: column for name, column in listed._asdict().items() if name not in ("low_hz", "high_hz")}
        values["hot_pixel_table"] = Entry({**columns, "dead_time_us": dead_us}, None, about)
    return listed_rows, values
