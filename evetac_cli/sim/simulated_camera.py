"""Events for dots that another simulator moves: positions over time in, the events of the sensor's camera out.

A simulator of robots computes a soft surface 60 or 240 times a second, at times of its own. A camera needs its dots at
all times. Between two given times up to a slice (1 ms) apart, dots move on straight lines, as in evetac's own scenes.
Over longer steps they follow a monotone cubic (PCHIP; F. N. Fritsch and J. Butland, 1984): smooth, and without the
overshoot of a spline, so that a dot at rest makes no event before it is touched. What happens within a step, such as a
dot that springs back, is lost.

Gel, friction, window, texture and the outline of an object are the other simulator's, or are left out.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.slip.architectures import Sensitivity
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.setup import plan, sampling
from evetac_cli.sim.setup.scene import GelSettings, Scene, SceneTimes
from evetac_cli.sim.setup.sensor import Sensor

SLICE_NS = SLICE_US * 1000
PIECES = 5  # of a dot's path in a slice, as many as the camera has scans
KNOWN = 4  # samples that a cubic piece is made of: its ends and one to either side
FARTHEST_PX = 1e5
LONGEST_S = 1e5
NOWHERE_M = np.zeros(2)  # there is no object behind a window


class SeenSlice(NamedTuple):
    """What a `SimulatedCamera` saw in a slice of 1 ms: its events, and the dots (dots, 2) in px at its end, the truth.

    >>> import numpy as np
    >>> rest = np.array([[300.0, 200.0], [360.0, 200.0]])
    >>> camera = evetac.SimulatedCamera(rest, rng=np.random.default_rng(0))
    >>> camera.step(0.0, rest), len(camera.step(0.001, rest + 0.5))
    ((), 1)
    """

    events: Events
    dot_xy_px: Floats


class SimulatedCamera:
    """The event camera of a simulated sensor, in front of dots that you move; see `step` and `play`.

    dot_xy: dots at rest, (dots, 2) or (rows, columns, 2), x right and y down. In px they are where the camera sees
    them; in mm they are on the gel, from the middle of the view.

    sensor: a name from `evetac.sensors()` or a TOML file, whose dot size, contrast, pixels, noise and readout are used;
    `randomized` samples a sensor. rng: the only source of noise and of all other random values. unit: px or mm.

    A camera can be passed as the gel of `evetac.DotTracker` and `evetac.SlipDetector`. InputError for invalid values.

    >>> import numpy as np
    >>> rest = np.stack(np.meshgrid(np.arange(60, 600, 60), np.arange(60, 440, 60)), axis=-1)
    >>> camera = evetac.SimulatedCamera(rest, rng=np.random.default_rng(0))
    >>> times_s = np.arange(13) / 60                      # a simulator with 60 steps per second
    >>> moved = rest + 4 * np.sin(9 * times_s)[:, None, None, None]
    >>> slices = camera.play(times_s, moved)
    >>> len(slices), sum(one.events.size for one in slices) > 1000
    (200, True)
    """

    def __init__(
        self, dot_xy: ArrayLike, sensor: str = "evetac", *, rng: np.random.Generator, unit: str = "px"
    ) -> None:
        if unit not in ("px", "mm"):
            raise _refused("unknown unit", "px or mm", unit)
        drawn, optics = rng.spawn(2)
        self.name, sensor_or_ranges = plan.named_sensor(sensor)
        one = sensor_or_ranges
        if not isinstance(one, Sensor):
            one = sampling.sample_sensor(one, drawn)
        self.frame_px = one.frame_px
        self.sensor: Sensor = one
        self._px_per_unit = 1.0 if unit == "px" else 1.0 / one.mm_per_px
        self._middle_px = np.zeros(2) if unit == "px" else np.array(one.frame_px) / 2
        grid_px = self._as_px(dot_xy)
        if grid_px.ndim not in (2, 3):
            raise _refused("dot_xy", "(dots, 2) or (rows, columns, 2)", grid_px.shape)
        grid_px = grid_px if grid_px.ndim == 3 else grid_px[None]
        if unit == "px":  # positions are seen through the lens
            one = replace(one, distortion=(0.0, 0.0))
        one = replace(one, dot_xy_px=tuple(tuple((float(x), float(y)) for x, y in row) for row in grid_px))
        scene = Scene(
            name="dots",
            kind="press",
            summary="another simulator moves the dots",
            time=SceneTimes(),
            gel=GelSettings(cut=False),
        )
        self.gel_camera = GelCamera(one, scene=scene, texture=None, rng=optics)
        self._rest_px = grid_px.reshape(-1, 2)
        self._metre_per_px = one.mm_per_px * 1e-3
        self.dot_xy_px: Floats = self.gel_camera.calibrated_grid_xy_px  # at rest, (rows, columns, 2)
        self.dot_radius_px = one.dot_radius_px
        self.window_px = None
        self.sensitivity: Sensitivity = one.sensitivity()
        self._start_s = 0.0  # the first time
        self._times_ns: list[int] = []  # from the first time
        self._shifts_m: list[Floats] = []
        self._slices = 0

    def step(self, t_s: float, dot_xy: ArrayLike) -> tuple[SeenSlice, ...]:
        """Take the dots' positions at a time, and return each slice of 1 ms that is now known.

        The first positions are those at the start of the first slice: begin at rest, or the first slice has the events
        of a jump. Times increase, by any steps. Positions have the shape and unit of those at rest. After steps of more
        than a slice, the slices up to the time before are returned, because the next position decides how a dot
        arrives; `finish` returns the others.

        InputError, before any change, for a time that does not increase and for invalid positions.
        """
        shift_m, time_ns = self._shift_m(dot_xy), self._time_ns(t_s)
        self._times_ns.append(time_ns)
        self._shifts_m.append(shift_m)
        if len(self._times_ns) == 1:
            return ()
        known_ns = time_ns if self._is_line(len(self._times_ns) - 2) else self._times_ns[-2]
        made = tuple(self._until(known_ns))
        self._forget()
        return made

    def finish(self) -> tuple[SeenSlice, ...]:
        """Return the remaining whole slices up to the last given time."""
        return tuple(self._until(self._times_ns[-1])) if self._times_ns else ()

    def play(self, t_s: ArrayLike, dot_xy: ArrayLike) -> tuple[SeenSlice, ...]:
        """Return each slice of 1 ms of a whole motion: times (n,) and positions (n, dots, 2).

        It equals `step` for each time, and `finish`.
        """
        times, places = np.asarray(t_s, np.float64), np.asarray(dot_xy, np.float64)
        if times.ndim != 1 or len(times) != len(places):
            raise _refused("t_s, dot_xy", "as many times as positions", f"{times.shape}, {places.shape}")
        slices: list[SeenSlice] = []
        for time_s, place in zip(times, places, strict=True):
            slices += self.step(float(time_s), place)
        return (*slices, *self.finish())

    def _as_px(self, dot_xy: ArrayLike) -> Floats:
        given = np.asarray(dot_xy, np.float64)
        if given.ndim < 2 or given.shape[-1] != 2 or not given.size:
            raise _refused("dot_xy", "(dots, 2) or (rows, columns, 2)", given.shape)
        places: Floats = given * self._px_per_unit + self._middle_px
        if not (np.abs(places) <= FARTHEST_PX).all():
            found = f"{places.min()} to {places.max()} px"
            raise _refused("dot_xy", f"finite positions, up to {FARTHEST_PX:g} px", found)
        return places

    def _shift_m(self, dot_xy: ArrayLike) -> Floats:
        """Return the displacements of the dots (dots, 2) from rest, in m on the gel."""
        places = self._as_px(dot_xy)
        if places.size != self._rest_px.size:
            raise _refused("dot_xy", f"{len(self._rest_px)} dots, as at rest", f"the shape {places.shape}")
        return (places.reshape(-1, 2) - self._rest_px) * self._metre_per_px

    def _time_ns(self, t_s: float) -> int:
        """Return the time from the first one."""
        seconds = float(t_s)
        if not (math.isfinite(seconds) and abs(seconds) <= LONGEST_S):
            raise _refused("t_s", f"a time within {LONGEST_S:g} s", t_s)
        if not self._times_ns:
            self._start_s = seconds
        time_ns = round((seconds - self._start_s) * 1e9)
        if self._times_ns and time_ns <= self._times_ns[-1]:
            raise _refused("t_s", f"a time after {self._start_s + self._times_ns[-1] * 1e-9:g} s", t_s)
        return time_ns

    def _is_line(self, at: int) -> bool:
        """Whether dots move on a straight line from the sample `at` to the next."""
        return at >= 0 and self._times_ns[at + 1] - self._times_ns[at] <= SLICE_NS

    def _until(self, known_ns: int) -> Iterator[SeenSlice]:
        """Yield the slices that end by this time."""
        while (self._slices + 1) * SLICE_NS <= known_ns:
            begin_ns = self._slices * SLICE_NS
            ends = np.searchsorted(self._times_ns, [begin_ns, begin_ns + SLICE_NS])
            at_ends = [self._times_ns[ends[0]] == begin_ns, self._times_ns[ends[1]] == begin_ns + SLICE_NS]
            pieces = 1 if all(at_ends) and ends[1] == ends[0] + 1 else PIECES  # from sample to sample: one line
            times = np.linspace(begin_ns, begin_ns + SLICE_NS, pieces + 1)
            path_m = self._shifts_at(times)
            self._slices += 1
            t0_us = (self._slices - 1) * SLICE_US
            events = self.gel_camera.render(path_m[-1], NOWHERE_M, 0.0, t0_us, None if pieces == 1 else path_m)
            yield SeenSlice(events, self.gel_camera.dot_xy_px.copy())

    def _shifts_at(self, times_ns: Floats) -> Floats:
        """Return the displacements (times, dots, 2) at times within the known samples."""
        from scipy.interpolate import PchipInterpolator  # takes a while to load

        at = np.clip(np.searchsorted(self._times_ns, times_ns, side="right") - 1, 0, len(self._times_ns) - 2)
        shifts = np.empty((len(times_ns), *self._rest_px.shape))
        for piece in np.unique(at):
            inside = at == piece
            if self._is_line(piece):
                first, last = self._times_ns[piece : piece + 2]
                share = ((times_ns[inside] - first) / (last - first))[:, None, None]
                shifts[inside] = (1 - share) * self._shifts_m[piece] + share * self._shifts_m[piece + 1]
            else:
                near = slice(max(piece - 1, 0), piece + 3)
                known = self._times_ns[near], np.stack(self._shifts_m[near])
                cubic = PchipInterpolator(np.array(known[0], np.float64), known[1])
                shifts[inside] = cubic(times_ns[inside])
        return shifts

    def _forget(self) -> None:
        """Forget samples that no later slice needs."""
        needed = int(np.searchsorted(self._times_ns, self._slices * SLICE_NS, side="right")) - 2
        if needed > KNOWN:
            del self._times_ns[:needed], self._shifts_m[:needed]


def _refused(what: str, expected: str, found: object) -> InputError:
    return InputError(f"{what}: invalid value", where="SimulatedCamera", expected=expected, found=str(found)[:100])
