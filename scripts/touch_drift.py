"""Measure the drift of an event tracker over minutes of pushes, remedies against it, and the detection of wrong dots.

    python scripts/touch_drift.py [--seed 60100] [--minutes 10] [--out docs/results]

A gripper holds an object that is pushed every 0.65 s. There are two courses: the object is released and gripped again
every minute, with one tracker for all grips; or it is held throughout. One tracker per remedy gets the same events. A
flash changes the events, so its trials are simulated separately.

Errors are measured at looks every half second, in the last five seconds of a period in which the object is held. The
table has the rms of the dots' errors and of their mean, and the largest error of any dot. It also has the net shear
error of a touch map of these dots, relative to a map of the true dots. All simulated, in about half the simulated time.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import untouched
from flash import dots_in_flash, place
from numpy.typing import NDArray
from script_tables import RESULTS, table_of, write
from untouched import UntouchedState

import evetac_cli as evetac
from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import Events, concatenate
from evetac_cli.jobs import Row
from evetac_cli.kernels.touch import touch_map, wrong_dots
from evetac_cli.kernels.touch.dot_motion import GelLayer
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.kernels.tracking.tracker import TrackerState
from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor

OBJECT = 8
MINUTE_S = 60
BLOCK = 500  # slices that are tracked together, with a look at the end of each block
LOOKS = 10
LAST_LOOK_S = 4  # before the end of a grip
AFTER_MINUTES = (1, 2, 5, 10)
FIRST_LOOK_S = 10
FRAME_PX = 0.1  # error of a frame, per dot and axis
FRAME_SHARES = {1: 0.4, 10: 0.7}  # correction gain, keyed by frame interval in s; chosen on seeds 7010-7012
FLASH_EVERY_S = 1
FLASH = (0.2, 0.1)
FLASH_SLICES = 2 * len(FLASH)  # slices whose events are kept from the tracker
# Motion per event, relative to `stable`: after a flash all pixels of a rim wait for a whole threshold, whereas usually
# some are half way. Chosen on seed 7010.
FLASH_EVENT = 1.4
WEAK = 5.0  # regulariser weight instead of 50: rims count ten times as much against neighbours
WRONG_PX = (1.0, 2.0)
# Pushes as in `handling`, in both directions, one every 0.65 s.
FORCES_N, FIRST_PUSH_S, PUSH_EVERY_S = (1.4, 1.2, -0.8, 1.6, 1.0, -1.2), 2.2, 0.65
SCENE = """
name = "pushed"
kind = "hold"
summary = "the gripper holds an object that is pushed every 0.65 s, and lets it go"
[time]
rest_s = 1.4
load_s = 0.2
longest_s = {length_s}
after_lost_s = 10.0
[gel]
cut = true
[gripper]
open_ticks = 40.0
close_s = 0.2
grip_s = 1.2
open_s = {open_s}
start_factor = [1.5, 3.0]
start_more_n = 1.0
friction_factor = [0.9, 1.1]
[push]
at_s = {at_s}
force_n = {force_n}
lasts_s = 0.12
[floor]
below_mm = [45.0, 55.0]
[randomise]
static_friction = [0.85, 1.15]
kinetic_share = [0.5, 0.7]
stribeck_mm_s = [5.0, 20.0]
memory_um = 50.0
pressure_exponent = 0.67
mass = [0.5, 1.5]
tilt_deg = [-1.8, 1.8]
kinetic_share_spread = 0.03
touch_mm = 3.0
"""
FLASHES = "[light]\nflash = {{every_s = {every_s}, brightness = {brightness}}}\n"


class Remedy:
    """A tracker and its remedy against drift: none, unless a subclass adds one."""

    name = "stable"

    def __init__(self, rest_px: Floats, radius_px: float) -> None:
        self.rest_px, self.radius_px = rest_px, radius_px
        self.state: TrackerState = tracker.start(rest_px, self.constants())

    def constants(self) -> tracker.TrackerConstants:
        """The constants of the tracker."""
        return PRESETS["stable"].for_dots(self.radius_px)

    def follow(self, events: Events, starts: NDArray[np.int64], true_px: Floats, number: int) -> None:
        """Take the events of some slices; those of slice k are in [starts[k], starts[k + 1]).

        true_px: (slices, dots, 2) at the end of each slice. number: of the first slice in the grip.
        """
        tracker.fold(self.state, events.x, events.y, events.p, starts)


class WeakNeighbours(Remedy):
    """Rims that count more against neighbours; `stable` always fits rims."""

    name = "stable, rims count ten times as much"

    def constants(self) -> tracker.TrackerConstants:
        """The constants of the tracker."""
        return replace(super().constants(), regulariser_weight=WEAK)


class Paper(Remedy):
    """The paper's tracker."""

    name = "paper"

    def constants(self) -> tracker.TrackerConstants:
        """The constants of the tracker."""
        return PRESETS["paper"]


class RestDetection(Remedy):
    """Dots are reset to rest when the gel is no longer touched."""

    name = "put back when nothing touches"

    def __init__(self, rest_px: Floats, radius_px: float) -> None:
        super().__init__(rest_px, radius_px)
        self.untouched: UntouchedState = untouched.start(rest_px)

    def follow(self, events: Events, starts: NDArray[np.int64], true_px: Floats, number: int) -> None:
        """Follow like `Remedy`, slice by slice."""
        for first, end in zip(starts[:-1], starts[1:], strict=True):
            tracker.step(self.state, events.x[first:end], events.y[first:end], events.p[first:end])
            if untouched.step(self.untouched, self.state.dot_xy_px, self.state.lost):
                place(self.state, self.rest_px)


class Frames(Remedy):
    """An occasional frame: the true dots with an error, which only a simulation can provide."""

    def __init__(self, rest_px: Floats, radius_px: float, every_s: int, rng: np.random.Generator) -> None:
        super().__init__(rest_px, radius_px)
        self.every_s, self.rng = every_s, rng
        self.name = f"a frame every {every_s} s"

    def follow(self, events: Events, starts: NDArray[np.int64], true_px: Floats, number: int) -> None:
        """Follow like `Remedy`, then use a frame if one is due."""
        super().follow(events, starts, true_px, number)
        if (number + len(starts) - 1) % (1000 * self.every_s) == 0:
            seen = true_px[-1] + self.rng.normal(size=self.rest_px.shape) * FRAME_PX
            place(self.state, seen, FRAME_SHARES[self.every_s])


class Flashes(Remedy):
    """A flash, under which the print brightens and bare gel does not; its slices are kept from the tracker."""

    name = f"a flash every {FLASH_EVERY_S} s"

    def __init__(self, rest_px: Floats, radius_px: float) -> None:
        super().__init__(rest_px, radius_px)
        self.shown_px: Floats | None = None  # the dots as shown by the last flash
        self.true_px = rest_px  # the true dots at that time

    def constants(self) -> tracker.TrackerConstants:
        """The constants of the tracker."""
        usual = super().constants()
        return replace(usual, event_px=FLASH_EVENT * usual.event_px)

    def follow(self, events: Events, starts: NDArray[np.int64], true_px: Floats, number: int) -> None:
        """Follow like `Remedy`; the slice in which the last pulse ends shows the dots' positions."""
        if number and number % (1000 * FLASH_EVERY_S) == 0:
            last = slice(starts[FLASH_SLICES - 1], starts[FLASH_SLICES])
            darker = events.p[last] == 0
            found = dots_in_flash(events.x[last][darker], events.y[last][darker], self.state.dot_xy_px, self.radius_px)
            place(self.state, found)
            self.shown_px, self.true_px = found, true_px[FLASH_SLICES - 1]
            starts = starts[FLASH_SLICES:]
        super().follow(events, starts, true_px, number)


@dataclass
class Looks:
    """Looks at one tracker at one time: errors of dots (looks, dots, 2) in px, and of net shear in N."""

    off_px: list[Floats] = field(default_factory=list)
    off_n: list[float] = field(default_factory=list)
    lost: int = 0

    def row(self) -> Row:
        """Return the row of the table."""
        off = np.array(self.off_px)  # NaN: a dot that is left out
        return {
            "rms_px": float(np.sqrt(np.nanmean((off**2).sum(axis=2)))),
            "common_px": float(np.sqrt((np.nanmean(off, axis=1) ** 2).sum(axis=1).mean())),
            "worst_px": float(np.nanmax(np.hypot(off[..., 0], off[..., 1]))),
            "rms_n": float(np.sqrt(np.mean(np.square(self.off_n)))),
            "lost": self.lost,
            "looks": len(self.off_n),
        }


@dataclass
class WrongDots:
    """How well a touch map's own patch identified wrong dots; px are from the median error."""

    by_px: dict[float, list[int]] = field(default_factory=lambda: {px: [0, 0] for px in WRONG_PX})  # found, total
    called: int = 0  # called wrong although off by less than the smallest of WRONG_PX
    right: int = 0

    def add(self, off_px: Floats, flags: Flags) -> None:
        """Add one look: errors (dots, 2) and the dots called wrong."""
        apart = np.hypot(*(off_px - np.median(off_px, axis=0)).T)
        for px, (found, there) in self.by_px.items():
            self.by_px[px] = [found + int((flags & (apart >= px)).sum()), there + int((apart >= px).sum())]
        self.called += int((flags & (apart < min(WRONG_PX))).sum())
        self.right += int((apart < min(WRONG_PX)).sum())


class Judge:
    """Compares dots with the true ones: in px, and in newtons by two touch maps."""

    def __init__(self, sensor: Sensor, rest_px: Floats) -> None:
        self.mm_per_px, self.middle_px = sensor.mm_per_px, np.array(sensor.frame_px) / 2
        layer = GelLayer(shear_modulus_pa=sensor.shear_modulus_pa)
        self.rest_mm = (rest_px - self.middle_px) * self.mm_per_px
        self.map = touch_map.start(self.rest_mm, layer, renews=False)
        self.known = wrong_dots.start(self.map.motion, self.map.cells.shape)
        self.looks: dict[tuple[str, str], Looks] = defaultdict(Looks)
        self.wrong: dict[str, WrongDots] = defaultdict(WrongDots)

    def net_n(self, dot_px: Floats, lost: Flags | None = None) -> Floats:
        """Return the net shear (2,) of a touch map of the dots, starting without a patch."""
        dots_mm = (dot_px - self.middle_px) * self.mm_per_px
        touch_map.step(self.map, self.rest_mm)
        touch_map.step(self.map, dots_mm, lost)
        touch_map.renew(self.map)
        touch_map.renew(self.map)
        return touch_map.step(self.map, dots_mm, lost).shear_n

    def look(self, at: str, true_px: Floats, remedies: list[Remedy]) -> None:
        """Compare all trackers at a named time."""
        true_n = self.net_n(true_px)
        for remedy in remedies:
            dots = remedy.state.dot_xy_px.copy()
            self._add(at, remedy.name, dots, true_px, true_n).lost = int(remedy.state.lost.sum())
            if type(remedy) is Remedy:
                self._look_for_wrong(at, dots, true_px, true_n)
            if isinstance(remedy, Flashes) and remedy.shown_px is not None:
                then_n = self.net_n(remedy.true_px)
                self._add(at, "as the flash alone shows them", remedy.shown_px, remedy.true_px, then_n)

    def _add(
        self, at: str, name: str, dots: Floats, true_px: Floats, true_n: Floats, without: Flags | None = None
    ) -> Looks:
        """Record the errors of estimated dot positions (n, 2) at one time; dots flagged by `without` are left out."""
        found, off = self.looks[at, name], dots - true_px
        if without is not None:
            off = np.where(without[:, None], np.nan, off)
        found.off_px.append(off)
        found.off_n.append(float(np.hypot(*(self.net_n(dots, without) - true_n))))
        return found

    def _look_for_wrong(self, at: str, dots: Floats, true_px: Floats, true_n: Floats) -> None:
        """Identify wrong dots with the patch found last, and estimate again without them."""
        moved_mm = (dots - self.middle_px) * self.mm_per_px - self.rest_mm
        flags = np.zeros(len(dots), np.bool_)
        if self.map.now is not None:
            flags = wrong_dots.wrong(self.known, moved_mm, np.ones(len(dots), np.bool_), self.map.now.fit.patch)
        self.wrong[at].add(dots - true_px, flags)
        self._add(at, "stable, without the dots that are found wrong", dots, true_px, true_n, flags)


def scene_text(length_s: int, flash: bool) -> str:
    """Return the scene of one grip."""
    at_s = np.arange(FIRST_PUSH_S, length_s - LAST_LOOK_S, PUSH_EVERY_S)
    text = SCENE.format(
        length_s=length_s,
        open_s=length_s - 3,
        at_s=[round(float(one), 3) for one in at_s],
        force_n=np.resize(FORCES_N, len(at_s)).tolist(),
    )
    return text + (FLASHES.format(every_s=FLASH_EVERY_S, brightness=list(FLASH)) if flash else "")


def blocks(scene: Path, seed: int) -> Iterator[tuple[evetac.Simulation, Events, NDArray[np.int64], Floats]]:
    """Yield the events of successive BLOCK slices, the starts of their slices, and the true dots at the end of each."""
    trial = evetac.simulate(str(scene), OBJECT, seed=seed)
    slices: list[Events] = []
    true_px: list[Floats] = []
    for events in trial:
        slices.append(events)
        true_px.append(np.array(trial.truth["truth/dot_xy_px"], np.float64).reshape(-1, 2))
        if len(slices) == BLOCK:
            starts = np.cumsum([0] + [one.size for one in slices]).astype(np.int64)
            yield trial, concatenate(slices), starts, np.stack(true_px)
            slices.clear()
            true_px.clear()


def times(length_s: int, minutes: int) -> list[tuple[int, str, int]]:
    """Return the last times of looks: number of the grip, name, and second within the grip."""
    grips = {minute: divmod(minute * MINUTE_S - 1, length_s)[0] for minute in AFTER_MINUTES if minute <= minutes}
    ends = {minute: minute * MINUTE_S - grip * length_s for minute, grip in grips.items()}
    return [(0, f"{FIRST_LOOK_S} s", FIRST_LOOK_S)] + [
        (grip, f"{minute} min", min(ends[minute], length_s - LAST_LOOK_S)) for minute, grip in grips.items()
    ]


def run(length_s: int, minutes: int, seed: int, flash: bool, judges: list[Judge]) -> Judge:
    """Run grips of a length for a number of minutes, with or without flashes; return their looks."""
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    due = times(length_s, minutes)
    remedies: list[Remedy] = []
    judge = judges[0] if judges else None
    with TemporaryDirectory() as folder:
        scene = Path(folder) / "pushed.toml"
        scene.write_text(scene_text(length_s, flash))
        for grip in range(minutes * MINUTE_S // length_s):
            for number, (trial, events, starts, true_px) in enumerate(blocks(scene, seed + grip)):
                if not remedies:
                    rest_px = np.asarray(trial.dot_xy_px, np.float64).reshape(-1, 2)
                    remedies = made(rest_px, trial.dot_radius_px, seed, flash)
                    judge = judge or Judge(sensor, rest_px)
                assert judge is not None
                for remedy in remedies:
                    remedy.follow(events, starts, true_px, number * BLOCK)
                now_s = (number + 1) * BLOCK / 1000
                for looked, words, until_s in due:
                    if looked == grip and until_s - LOOKS * BLOCK / 1000 < now_s <= until_s:
                        judge.look(words, true_px[-1], remedies)
    assert judge is not None
    return judge


def made(rest_px: Floats, radius_px: float, seed: int, flash: bool) -> list[Remedy]:
    """Return the trackers for events with a flash, or without."""
    if flash:
        return [Flashes(rest_px, radius_px)]
    plain: list[Callable[[Floats, float], Remedy]] = [Remedy, WeakNeighbours, RestDetection, Paper]
    frames = [Frames(rest_px, radius_px, every_s, np.random.default_rng([seed, every_s])) for every_s in FRAME_SHARES]
    return [*(one(rest_px, radius_px) for one in plain), *frames]


def rows_of(course: str, judge: Judge) -> list[Row]:
    """Return a row for each remedy and time."""
    return [{"course": course, "remedy": name, "after": at, **looks.row()} for (at, name), looks in judge.looks.items()]


def wrong_rows(course: str, judge: Judge) -> list[Row]:
    """Return a row for each time."""
    rows = []
    for at, wrong in judge.wrong.items():
        row: Row = {"course": course, "after": at, "called": wrong.called, "right": wrong.right}
        for px, (found, there) in wrong.by_px.items():
            row |= {f"there_{px:g}": there, f"found_{px:g}": found}
        row["false"] = wrong.called / max(wrong.right, 1)
        rows.append(row)
    return rows


DRIFT_COLUMNS = {"course": "{course}", "dots": "{remedy}"}
DRIFT_CELLS = {
    "heading": "{after}",
    "cell": "{rms_px:.2f}, {common_px:.2f}, {worst_px:.1f} px; {rms_n:.2f} N",
}
WRONG_COLUMNS = {
    "course": "{course}",
    "after": "{after}",
    "off by 1 px or more: found of": "{found_1} of {there_1}",
    "by 2 px or more: found of": "{found_2} of {there_2}",
    "others called wrong": "{false:.1%}",
}


def main() -> None:
    """Simulate, track and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=60100, help="seed of the first grip; each further grip adds one")
    parser.add_argument("--minutes", type=int, default=10, help="length of each course")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    rows, wrong = [], []
    for course, length_s in (("let go every minute", MINUTE_S), ("held throughout", chosen.minutes * MINUTE_S)):
        judge = run(length_s, chosen.minutes, chosen.seed, False, [])
        judge = run(length_s, chosen.minutes, chosen.seed, True, [judge])
        rows += rows_of(course, judge)
        wrong += wrong_rows(course, judge)
        sys.stderr.write(f"{course}: done\n")
    command = f"python scripts/touch_drift.py --seed {chosen.seed} --minutes {chosen.minutes}"
    sizes = {"trial_seeds": list(range(chosen.seed, chosen.seed + chosen.minutes))}
    title = "Drift under pushes: error of a dot (rms), of all together (rms), of the worst, and of net shear (rms)"
    drift = table_of("touch-drift", title, DRIFT_COLUMNS, rows, command, sizes, across=DRIFT_CELLS)
    title = "Dots of the tracker `stable` that are off, and that are called wrong"
    write(chosen.out, drift, table_of("touch-wrong-dots", title, WRONG_COLUMNS, wrong, command, sizes))


if __name__ == "__main__":
    main()
