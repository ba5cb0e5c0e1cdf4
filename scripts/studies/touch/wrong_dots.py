"""Displace dots on purpose: how many are found, how many others are called wrong, and the benefit for a touch map.

    python scripts/studies/touch/wrong_dots.py [--seeds 107700-107703] [--out docs/results]

Contacts of eight shapes with known tractions (contact_maker.py) are seen with a tracker's errors
after some time: 0.1 px of each dot and 0.2 px of all. One, three or six random dots are displaced further, in random
directions. The patch is found with the wrong dots among the others, then twice without those that are called wrong.
Simulated; the constants of kernels/touch/wrong_dots.py were chosen on seeds 7000-7011.
"""

import argparse
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.jobs import Row
from evetac_cli.kernels.touch import touch_map, wrong_dots
from evetac_cli.kernels.touch.dot_motion import GelLayer
from evetac_cli.kernels.touch.touch_map import TouchReading, TouchState
from evetac_cli.kernels.touch.wrong_dots import LayerMotion
from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor
from scripts.reproduce.facts import RESULTS, ranges
from scripts.reproduce.made_tables import table_of, write
from scripts.studies.rows import seeds_of
from scripts.studies.touch.contact_maker import SHAPES, ContactMaker, KnownContact, on_coarse_cells
from scripts.studies.touch.contacts import contacts_of, dots_of

OWN_PX, COMMON_PX = 0.1, 0.2
WRONG, OFF_PX = (1, 3, 6), (0.5, 1.0, 2.0, 5.0)
TIMES = 2  # how often wrong dots are searched for


def estimate(state: TouchState, moved_mm: Floats, known: LayerMotion | None) -> tuple[TouchReading, Flags]:
    """Return a touch map's estimate for dots (n, 2), and which dots it calls wrong; all are trusted without `known`."""
    flags: Flags = np.zeros(len(moved_mm), np.bool_)
    everyone = ~flags
    dots_mm = state.rest_mm + moved_mm
    touch_map.step(state, state.rest_mm)
    touch_map.step(state, dots_mm)
    touch_map.renew(state)
    for _ in range(TIMES):
        if known is not None and state.now is not None:
            flags = wrong_dots.wrong(known, moved_mm, everyone, state.now.fit.patch)
            touch_map.step(state, dots_mm, flags)
        touch_map.renew(state)
    return touch_map.step(state, dots_mm, flags), flags


def judged(contact: KnownContact, reading: TouchReading, state: TouchState) -> tuple[float, float]:
    """Return the error of net shear in N, and of the shear field relative to the true one."""
    shear = on_coarse_cells(contact, state.cells.x_mm, state.cells.y_mm)[:2]
    off_n = float(np.hypot(*(reading.shear_n - contact.net_shear_n)))
    return off_n, float(np.linalg.norm(reading.shear_pa - shear) / np.linalg.norm(shear))


def rows_of(contacts: list[KnownContact], rest_mm: Floats, mm_per_px: float) -> list[Row]:
    """Return a row for each number of wrong dots and each size of their error, and one without wrong dots."""
    state = touch_map.start(rest_mm, renews=False)
    known = wrong_dots.start(state.motion, state.cells.shape)
    rows = []
    for count, off_px in [(0, 0.0)] + [(count, off_px) for count in WRONG for off_px in OFF_PX]:
        found, flagged, with_them, without = [], [], [], []
        for contact in contacts:
            rng = np.random.default_rng([contact.seed, SHAPES.index(contact.shape), 2])
            errors = rng.normal(size=rest_mm.shape) * OWN_PX + rng.normal(size=2) * COMMON_PX
            chosen, ways = rng.permutation(len(rest_mm))[:count], rng.uniform(0, 2 * np.pi, max(WRONG))[:count]
            errors[chosen] += off_px * np.stack([np.cos(ways), np.sin(ways)], axis=1)
            nearer = rest_mm * (contact.dot_motion_mm[:, 2:] / GelLayer().lens_mm)
            moved = contact.dot_motion_mm[:, :2] + nearer + errors * mm_per_px
            reading, flags = estimate(state, moved, known)
            without.append(judged(contact, reading, state))
            with_them.append(judged(contact, estimate(state, moved, None)[0], state))
            found.append(flags[chosen].sum())
            flagged.append(flags.sum() - flags[chosen].sum())
        right = len(contacts) * (len(rest_mm) - count)
        shear_n, field = np.median(with_them, axis=0)
        without_n, without_field = np.median(without, axis=0)
        rows.append(
            {
                "wrong": count,
                "off_px": off_px if count else None,
                "n": len(contacts),
                "found": float(np.sum(found) / (count * len(contacts))) if count else None,
                "false": float(np.sum(flagged) / right),
                "shear_with_n": float(shear_n),
                "shear_without_n": float(without_n),
                "field_with": float(field),
                "field_without": float(without_field),
            }
        )
    return rows


COLUMNS = {
    "wrong dots": "{wrong}",
    "off by [px]": "{off_px:g}",
    "contacts": "{n}",
    "found": "{found:.0%}",
    "others called wrong": "{false:.1%}",
    "net shear, error with them [N]": "{shear_with_n:.3f}",
    "without those called wrong [N]": "{shear_without_n:.3f}",
    "field, error with them": "{field_with:.2f}",
    "without": "{field_without:.2f}",
}


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=seeds_of, default="107700-107703", help="FIRST-LAST; a contact of each shape per seed"
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the table")
    chosen = parser.parse_args()
    seeds = list(chosen.seeds)
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm = dots_of(sensor)
    rows = rows_of(contacts_of(ContactMaker(rest_mm), seeds), rest_mm, sensor.mm_per_px)
    command = f"python scripts/studies/touch/wrong_dots.py --seeds {ranges(seeds)}"
    title = "Dots that are wrong on purpose; errors are medians over contacts"
    write(chosen.out, table_of("touch-wrong-injected", title, COLUMNS, rows, command, {"contact_seeds": seeds}))


if __name__ == "__main__":
    main()
