"""Common parts of rows: means of known values; of `evaluate cost` settings, run times and the plot of errors.

Settings are compared in pairs, on the same trials. The interval is Student's for the mean of paired differences,
two-sided, at CONFIDENCE. A bootstrap would be too narrow: with the few trials that fit into three minutes it only
resamples the same few values.
"""

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import flag_of
from evetac_cli.commands.trials import SOLVER_OPTIONS, Trials
from evetac_cli.evaluate.common import picture
from evetac_cli.jobs import Progress, Row, Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate

Amount = TypeVar("Amount")
Item = TypeVar("Item")

FLAGS = {item.name: flag_of(item) for item in fields(Trials) if item.name in SOLVER_OPTIONS}
STILL, REFERENCE = "standing still", "reference"
REAL_TIME_US = 1000.0  # run time per simulated millisecond at real-time speed
UNITS = ("um", "us", "px", "ms", "share")
UM_PER_PX = 32.9  # of the sensor `evetac`
CONFIDENCE = 0.95
WARM_UP, FEWEST = 20, 30  # untimed calls, and least number of timed ones


@dataclass(frozen=True)
class Extent(Generic[Amount]):
    """Amount to measure, without and with `--full`."""

    quick: Amount
    full: Amount

    def pick(self, full: bool) -> Amount:
        """Return the amount with `--full` or without."""
        return self.full if full else self.quick


def collect(rows: Iterable[Row], total: int, progress: Progress) -> Rows:
    """Measure row after row, and report the progress towards `total`."""
    measured: Rows = []
    for row in rows:
        measured.append(row)
        progress(len(measured), total)
    return measured


def each(items: Collection[Item], progress: Progress, unit: str = "") -> Iterator[Item]:
    """Yield the items, and report the progress after each, in a unit."""
    for number, item in enumerate(items, start=1):
        yield item
        progress(number, len(items), unit)


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the known, finite values; None without any."""
    known = _known(values)
    return float(np.mean(known)) if known else None


def sd(values: Iterable[float | None]) -> float | None:
    """Return the standard deviation of the known, finite values; None for fewer than two."""
    known = _known(values)
    return float(np.std(known, ddof=1)) if len(known) > 1 else None


def quantile(values: Iterable[float | None], share: float = 0.5) -> float | None:
    """Return a quantile of the known, finite values, by default the median; None without any."""
    known = _known(values)
    return float(np.quantile(known, share)) if known else None


def _known(values: Iterable[float | None]) -> list[float]:
    return [float(value) for value in values if value is not None and np.isfinite(value)]


def resampled(values: Iterable[float | None]) -> Estimate | None:
    """Return the mean of the known, finite values with its interval from resampling them; None for fewer than two."""
    known = np.array(_known(values))
    if len(known) < 2:
        return None
    return estimates.ratio_of_clusters(known, np.ones(len(known)), estimates.cluster_weights(range(len(known))))


def ends(name: str, estimate: Estimate | None) -> dict[str, float | None]:
    """Return the columns `<name>_low` and `<name>_high` of an interval; None without one."""
    low, high = (None, None) if estimate is None else estimate[1:]
    return {f"{name}_low": low, f"{name}_high": high}


def run_times(times_us: NDArray[np.float64], name: str = "time") -> Row:
    """Return the columns `<name>_us_median` and `<name>_us_p99` of run times; None if nothing was timed."""
    if not len(times_us):
        return {f"{name}_us_median": None, f"{name}_us_p99": None}
    return {
        f"{name}_us_median": float(np.median(times_us)),
        f"{name}_us_p99": float(np.percentile(times_us, 99)),
    }


def timed_us(act: Callable[[], Any], repeats: int, longest_s: float = math.inf) -> Floats:
    """Return run times of `act` in us after some untimed calls; fewer, but at least FEWEST, if they take too long."""
    for _ in range(WARM_UP):
        act()
    took_us: list[float] = []
    started = time.perf_counter()
    while len(took_us) < repeats and (len(took_us) < FEWEST or time.perf_counter() - started < longest_s):
        begin = time.perf_counter()
        act()
        took_us.append((time.perf_counter() - begin) * 1e6)
    return np.array(took_us)


@dataclass(frozen=True)
class SolverSetting:
    """One solver setting: its line in the plot, its value on that line, and the scene's table [solver]."""

    line: str
    value: str = ""
    solver: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The entry in the column `setting`: `fixed step, 0.25 ms`."""
        return f"{self.line}, {self.value}" if self.value else self.line

    @property
    def flags(self) -> str:
        """The flags of `record` and `grasp` for this setting, such as `--step-ms 0.25`; empty for the default."""
        return " ".join(f"{FLAGS[key]} {value:g}" for key, value in self.solver.items())


def line(name: str, key: str, values: tuple[float, ...], unit: str = "", **others: float) -> list[SolverSetting]:
    """Return the settings of one line: a key of the table [solver] with each of these values, plus other fixed keys."""
    return [SolverSetting(name, f"{value:g} {unit}".rstrip(), {key: value, **others}) for value in values]


def size_in(rows: Rows) -> tuple[float, float]:
    """Return width and height in inches; the height grows with the number of different values in the column `part`."""
    return 14.0, 4.2 * len({row.get("part") for row in rows})


def draw(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot log error over log run time: a row of panels per value of `part`, a panel per error, a line per setting.

    A setting is `line, knob`, or a point without a knob. `standing still` and `reference` are horizontal lines across
    the panel.
    """
    parts = list(dict.fromkeys(row.get("part", "") for row in rows))
    for subfigure, part in zip(figure.subfigures(len(parts), 1, squeeze=False)[:, 0], parts, strict=True):
        part_rows = [row for row in rows if row.get("part", "") == part]
        names = [name for name in errors if name in part_rows[0]]
        if len(parts) > 1:
            subfigure.suptitle(part)
        panels = picture.panels(subfigure, len(names), len(names))
        for axes, name in zip(panels, names, strict=True):
            draw_panel(axes, part_rows, name)
        picture.label_x(panels, "run time per millisecond\n(one slice), median [us]")
        picture.legend(subfigure, panels)


def draw_panel(axes: Any, rows: Rows, error: str) -> None:
    """Draw one kind of error; an error of 0 has no position on a logarithmic axis and is left out."""
    lines: dict[str, Rows] = {}
    for row in rows:
        if row["setting"] not in (STILL, REFERENCE):
            lines.setdefault(row["setting"].rpartition(", ")[0] or row["setting"], []).append(row)
        elif row[error]:
            axes.axhline(row[error], color="0.3", linewidth=1.2, linestyle="-.", label=row["setting"])
    for number, (line, members) in enumerate(lines.items()):
        points = [row for row in members if row[error] and np.isfinite(row[error])]
        if points:
            knobs = [row["setting"].rpartition(", ")[2] for row in members]
            label = line if knobs == [line] else f"{line}, {knobs[0]} to {knobs[-1]}"
            axes.plot(
                [row["time_us_median"] for row in points],
                [row[error] for row in points],
                label=label,
                **picture.series(number),
            )
    axes.axvline(REAL_TIME_US, color="0.3", linewidth=1, linestyle="--", label="real time")
    first, *rest = error.removeprefix("error_").split("_")
    title, unit = (" ".join(rest), f" [{first}]") if first in UNITS else (" ".join((first, *rest)), "")
    axes.set(title=title, ylabel=f"error{unit}" + (f", 1 px is {UM_PER_PX:g} um" if first == "um" else ""))
    if any(len(line.get_xdata()) and line.get_marker() != "None" for line in axes.lines):
        for axis in (axes.xaxis, axes.yaxis):
            picture.log_axis(axis)
    else:
        picture.say_instead(axes, "errors are 0 or unknown")


class ConfidenceInterval(NamedTuple):
    """Mean of paired differences, the ends of its interval, and the number of trials; None if too few."""

    mean: float | None
    low: float | None
    high: float | None
    trials: int

    def columns(self, name: str, unit: str = "") -> Row:
        """Return the columns `name`, `interval_low<unit>` and `interval_high<unit>`."""
        return {name: self.mean, f"interval_low{unit}": self.low, f"interval_high{unit}": self.high}


def difference(ours: Floats, theirs: Floats) -> ConfidenceInterval:
    """Return the mean of ours - theirs over the trials in which both are known (not NaN)."""
    apart = ours - theirs
    apart = apart[np.isfinite(apart)]
    count = len(apart)
    if count < 2:
        return ConfidenceInterval(mean(apart), None, None, count)
    middle = float(apart.mean())
    spread = float(apart.std(ddof=1))
    from scipy import stats  # takes half a second to load

    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1)) * spread / math.sqrt(count)
    return ConfidenceInterval(middle, middle - half, middle + half, count)
