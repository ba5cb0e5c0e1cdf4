"""Error against run time of the numerical choices of the mechanics with constant friction.

For friction that falls with speed, as in the scenes, see unloading.

One trial is simulated repeatedly (gel_trial): a cylinder of 100 g, held slightly tilted and off its centre of mass,
while the grip falls from 2 to 0.2 N within 0.2 s. It bounces on the gel, slips in part, turns, and falls. Three choices
are compared: the integrator and its time step; the number of nodes; and the layer's response to shear and pressure.
Layer orders are 0: independent springs, which pressure does not squeeze aside; 1: the sheet inside the gel, the one in
use; 2: the exact layer, see kernels/gel_layer. Order 2 has a closed form only if the layer extends beyond the pad. A
layer of order 1 that also extends beyond it separates the error of the layer from the effect of the pad's edge.

Each comparison changes one choice and has its own reference, which differs only in that choice. So the errors of the
other choices do not hide it. The error of the time reference itself is bounded by step doubling: with a first-order
method, its difference from the solution at twice the step equals its difference from the truth.

An error is the root mean square, over samples every 10 ms, of the distance between the object's positions, or of the
distance between displacements of the gel over nodes (or points). Times are per simulated millisecond on one core, as
thread time, so that other programs do not count.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

from evetac_cli.evaluate.cost.gel_reference import simulate_dense, simulate_explicit
from evetac_cli.evaluate.cost.gel_trial import (
    PAD_M,
    SAMPLE_S,
    GelMotion,
    GelTrial,
    draw_trial,
    simulate,
)
from evetac_cli.evaluate.rows import Extent, run_times
from evetac_cli.jobs import Row
from evetac_cli.sim.gel.contact import pad_nodes

PART = "mechanics, constant friction"
THETAS = (1.0, 0.51, 0.5)
REFERENCE_THETA = 0.51
# Time steps, each of which divides 10 ms, and grids (columns, rows).
STEPS_US = Extent[tuple[float, ...]](
    quick=(10_000, 5_000, 2_000, 1_000, 500, 200, 100),
    full=(10_000, 5_000, 2_000, 1_000, 500, 200, 100, 50, 20),
)
EXPLICIT_US = Extent[tuple[float, ...]](
    quick=(1_000, 100, 20, 10, 8, 5, 4, 2, 1),
    full=(1_000, 100, 20, 10, 8, 5, 4, 2, 1, 0.5, 0.25),
)
REFERENCE_US = Extent(quick=5.0, full=2.0)
NODES = Extent[tuple[tuple[int, int], ...]](
    quick=((8, 10), (14, 10), (24, 18), (32, 24)),
    full=((8, 10), (14, 10), (24, 18), (32, 24), (48, 36)),
)
FINEST_NODES = Extent(quick=(64, 48), full=(96, 72))


def errors_um(motion: GelMotion, reference: GelMotion) -> tuple[float, float]:
    """Return root mean square distances of the object's position and of the gel from a reference.

    NaN after a blow-up.
    """
    if len(motion.pose) == 0:
        return math.nan, math.nan
    square = ((motion.pose - reference.pose)[:, :2] ** 2).sum(-1).mean()
    gel_square = ((motion.gel_m - reference.gel_m) ** 2).sum(-1).mean()
    return 1e6 * math.sqrt(square), 1e6 * math.sqrt(gel_square)


def row(setting: str, motion: GelMotion, reference: GelMotion | None, outcome: str = "finished") -> Row:
    """Return the row of a setting; without a reference it is a reference itself and has no error."""
    blown_up = not math.isnan(motion.blown_up_s)
    object_um, gel_um = errors_um(motion, reference) if reference else (math.nan, math.nan)
    return {
        "part": PART,
        "setting": setting,
        "error_um_object_rms": None if math.isnan(object_um) else object_um,
        "error_um_gel_rms": None if math.isnan(gel_um) else gel_um,
        **run_times(motion.block_us),
        "times_real_time": 1e3 / float(motion.block_us.mean()),
        "outcome": f"blew up after {motion.blown_up_s * 1e3:.3g} ms" if blown_up else outcome,
    }


def time_step_text(dt_us: float) -> str:
    """Return a time step as in the name of a setting: 1 ms, 0.1 ms, 20 us."""
    return f"{dt_us / 1e3:g} ms" if dt_us >= 100 else f"{dt_us:g} us"


def time_reference(trial: GelTrial, dt_us: float = REFERENCE_US.quick) -> tuple[GelMotion, Row]:
    """Return the time reference, with a step far below all others, and its row: error bounded by step doubling.

    Its theta of 0.51 leaves almost no first-order error and still damps ringing. An error falls at least in proportion
    to the step, e(2 dt) >= 2 e(dt), so the difference of the two solutions, which is the row's error, is >= e(dt).
    """
    twice = simulate(trial, 2e-6 * dt_us, REFERENCE_THETA, tolerance=1e-8)
    once = simulate(trial, 1e-6 * dt_us, REFERENCE_THETA, tolerance=1e-8)
    setting = f"reference: theta {REFERENCE_THETA:g}, dt {time_step_text(dt_us)}"
    return once, row(setting, once, twice, "error bounded by step doubling")


def implicit_row(trial: GelTrial, reference: GelMotion, theta: float, dt_us: float) -> Row:
    """Return the row of `gel.step` at a theta and a time step."""
    return row(f"theta {theta:g}, dt {time_step_text(dt_us)}", simulate(trial, 1e-6 * dt_us, theta), reference)


def explicit_row(trial: GelTrial, reference: GelMotion, dt_us: float) -> Row:
    """Return the row of the explicit integrator at a time step, even if it blows up."""
    return row(f"explicit, dt {time_step_text(dt_us)}", simulate_explicit(trial, 1e-6 * dt_us), reference)


def node_rows(
    trial: GelTrial,
    counts: Iterable[tuple[int, int]] = NODES.quick,
    finest: tuple[int, int] = FINEST_NODES.quick,
    dt_s: float = 1e-3,
) -> Iterator[Row]:
    """Yield rows of grids against a much finer one, at theta 0.51 and the same time step.

    Gel errors at 8 x 7 points.
    """
    x, y = 0.45 * PAD_M[0], 0.45 * PAD_M[1]
    points = pad_nodes(8, 7, (-x, x), (-y, y)).reshape(-1, 2)

    def motion(columns: int, rows: int) -> GelMotion:
        return simulate(replace(trial, columns=columns, rows=rows), dt_s, 0.51, points_xy_m=points)

    reference = motion(*finest)
    for columns, rows in counts:
        yield row(f"{columns} x {rows} nodes", motion(columns, rows), reference)
    yield row(f"{finest[0]} x {finest[1]} nodes", reference, None, "the reference of the grids")


def layer_rows(trial: GelTrial, dt_s: float = 1e-3) -> Iterator[Row]:
    """Yield rows of layers of order 0, 1, and 1 beyond the pad, against order 2; same grid and time step."""
    reference = simulate_dense(trial, 2, dt_s, 0.51)
    for order in (0, 1):
        layered = replace(trial, material=replace(trial.material, coupled=order == 1))
        yield row(f"layer order {order}", simulate(layered, dt_s, 0.51), reference)
    yield row("layer order 1 beyond the pad", simulate_dense(trial, 1, dt_s, 0.51, goes_on=True), reference)
    yield row("layer order 2, exact, on beyond the pad", reference, None, "the reference of the layers")


def row_count(full: bool) -> int:
    """Return the number of rows of `mechanics_rows`, with three references and three more layers."""
    implicit = len(THETAS) * len(STEPS_US.pick(full))
    return implicit + len(EXPLICIT_US.pick(full)) + len(NODES.pick(full)) + 6


def mechanics_rows(seed: int, full: bool) -> Iterator[Row]:
    """Yield all rows of the mechanics."""
    trial = draw_trial(seed)
    short = replace(trial, seconds=SAMPLE_S)
    simulate(short, 1e-3, 0.51)  # compiles
    simulate_explicit(short, 1e-5)
    reference, reference_row = time_reference(trial, REFERENCE_US.pick(full))
    yield reference_row
    for theta in THETAS:
        for dt_us in STEPS_US.pick(full):
            yield implicit_row(trial, reference, theta, dt_us)
    for dt_us in EXPLICIT_US.pick(full):
        yield explicit_row(trial, reference, dt_us)
    yield from node_rows(trial, NODES.pick(full), FINEST_NODES.pick(full))
    yield from layer_rows(trial)
