"""When the object of a case begins to slide, against the same case in steps fifty times as small.

The onset is that of gross slip in every loaded node: the moment at which the object has slid by half a pixel since the
last stuck node let go. An episode of gross slip is over when a node has been stuck for longer than 3 ms.

Why so: where friction falls with the slip speed, a node lets go within some ten microseconds. So the onset is what
suffers first from steps that are too long.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from evetac_cli.numerics.bounds import ONSET, Bound
from evetac_cli.numerics.gel.case import COULOMB, GelCase, stiff
from evetac_cli.numerics.gel.trial import GRAVITY_M_S2
from evetac_cli.sim.gel import gel
from evetac_cli.sim.gel.contact import gap_profile, pressure

Floats = NDArray[np.float64]

SLID_M = 0.5 * 0.0329e-3  # half a pixel of the default sensor
EPISODE_S = 3e-3
REFERENCE_S = (2e-5, 4e-5)  # steps of the reference, and of the one that shows how far the reference itself is off
WEAKENING = gel.Friction(0.8, 0.64, 0.010)  # as the scenes draw it ...
CORNER = gel.Friction(0.8, 0.60, 0.005)  # ... and at the corner of their ranges where it falls the most
TO_A_TENTH = gel.Friction(0.8, 0.08, 0.010)
WEIGHT_ON_S = 0.08  # in which the weight is handed over, where the grip falls slowly
FAST_S, SLOW_S = 0.2, 0.45


def onset_cases() -> list[tuple[GelCase, float]]:
    """Cases in which a tilted cylinder that is held beside its middle begins to slide, and how long each takes in s."""
    constant = GelCase("", friction=COULOMB, centre_m=(1e-3, 1.5e-3), shares=_under_cylinder)
    scene, corner = replace(constant, friction=WEAKENING), replace(constant, friction=CORNER)
    fast, slow = (partial(_unloaded, fast) for fast in (True, False))
    held, wet = partial(_held, 1.1), replace(scene, becomes=(0.15, _tenth(WEAKENING)))
    return [
        (fast("grip falls at 9 N/s, friction constant", constant), FAST_S),
        (fast("grip falls at 9 N/s, friction falls to 0.8 of it at 10 mm/s", scene), FAST_S),
        (fast("grip falls at 9 N/s, friction falls to 0.75 of it at 5 mm/s", corner), FAST_S),
        (slow("grip falls at 2 N/s, friction constant", constant), SLOW_S),
        (slow("grip falls at 2 N/s, friction falls to 0.8 of it at 10 mm/s", scene), SLOW_S),
        (slow("grip falls at 2 N/s, friction falls to 0.75 of it at 5 mm/s", corner), SLOW_S),
        (slow("slides, friction falls to a tenth with speed", replace(scene, friction=TO_A_TENTH)), SLOW_S),
        (slow("slides, gel 10 times as stiff", replace(scene, material=stiff(10.0))), SLOW_S),
        (slow("slides, gel a tenth as stiff", replace(scene, material=stiff(0.1))), SLOW_S),
        (slow("slides, object of 5 g", scene, 0.005), SLOW_S),
        (slow("slides, object of 2 kg", scene, 2.0), SLOW_S),
        (held("slides, friction falls to a tenth at 0.15 s", wet), FAST_S),
        (held("slides, hand jerks by 20 m/s2 for 30 ms", replace(scene, force=_jerked)), FAST_S),
    ]


def _under_cylinder(nodes: Floats) -> Floats:
    return np.asarray(pressure(0.4e-3, gap_profile(nodes, "cylinder", 0.06, 0.01), 1.0))


def _unloaded(fast: bool, name: str, case: GelCase, mass_kg: float = 0.1) -> GelCase:
    """The case with a grip that falls in proportion to a mass: from 2 N at 9 N/s, or from 1.1 N at 2 N/s, for 100 g."""
    share = mass_kg / 0.1
    load = partial(_falling, share, 2.0, 9.0, 0.0) if fast else partial(_falling, share, 1.1, 2.0, WEIGHT_ON_S)
    force = None if fast else partial(_handed_over, mass_kg * GRAVITY_M_S2)
    return replace(case, name=name, mass_kg=mass_kg, inertia_kg_m2=4e-4 * mass_kg, load=load, force=force)


def _held(grip_n: float, name: str, case: GelCase) -> GelCase:
    return replace(case, name=name, load=lambda _: grip_n, force=case.force or partial(_handed_over, 0.981))


def _falling(share: float, from_n: float, rate_n_s: float, since_s: float, time_s: float) -> float:
    return share * max(from_n - rate_n_s * max(time_s - since_s, 0.0), 0.0)


def _handed_over(weight_n: float, time_s: float) -> tuple[float, float, float]:
    """A weight that is on after WEIGHT_ON_S."""
    return weight_n * (0.5 - 0.5 * math.cos(math.pi * min(time_s / WEIGHT_ON_S, 1.0))), 0.0, 0.0


def _jerked(time_s: float) -> tuple[float, float, float]:
    """The weight of 100 g, and from 0.12 s on, for 30 ms, what a hand adds that is jerked upwards."""
    since = (time_s - 0.12) / 0.03
    jerk_n = 0.1 * 20.0 * math.sin(math.pi * since) if 0.0 <= since <= 1.0 else 0.0
    return _handed_over(0.1 * GRAVITY_M_S2, time_s)[0] + jerk_n, 0.0, 0.0


def _tenth(friction: gel.Friction) -> gel.Friction:
    return replace(friction, static=0.1 * friction.static, kinetic=0.1 * friction.kinetic)


def onset_s(case: GelCase, within_s: float, dt_s: float, theta: float) -> float:
    """When the object has slid by half a pixel, interpolated within the step; NaN if it does not within this time."""
    state, shares = case.start()
    slid_m, stuck_s = np.zeros(2), 0.0
    for number in range(round(within_s / dt_s)):
        info, _ = case.step(state, shares, number, dt_s, theta)
        if info.slip_fraction < 1.0 or case.load(number * dt_s) <= 0.0:
            stuck_s += dt_s
            if stuck_s > EPISODE_S:
                slid_m[:] = 0.0
            continue
        stuck_s = 0.0
        before_m = math.hypot(*slid_m)
        slid_m += dt_s * np.array(info.slip_velocity_m_s)
        after_m = math.hypot(*slid_m)
        if after_m > SLID_M:
            return dt_s * (number + (SLID_M - before_m) / (after_m - before_m))
    return math.nan


def onset_error(case: GelCase, within_s: float, theta: float) -> tuple[tuple[Bound, float], str]:
    """The error of the onset in ms, at most: the distance from the reference and how far that may be off; in words."""
    onset, reference, coarser = (onset_s(case, within_s, dt_s, theta) for dt_s in (case.dt_s, *REFERENCE_S))
    own_ms = 1e3 * abs(reference - coarser)
    words = f"slides {_at(onset)}, reference {_at(reference)} (within {own_ms:.2g} ms)"
    return (ONSET, 1e3 * abs(onset - reference) + own_ms), words


def _at(time_s: float) -> str:
    return "never" if math.isnan(time_s) else f"at {1e3 * time_s:.2f} ms"
