"""Evaluate touch maps on contacts with known tractions: errors, coverage of the standard deviations, and run time.

    python scripts/studies/touch/contacts.py [--seeds 107000-107024] [--out docs/results]
    python scripts/studies/touch/contacts.py --calibrate --seeds 6000-6049

An independent implementation of the layer (contact_maker.py) computes contacts of eight shapes.
The dots of the sensor `evetac` are seen with the tracker's errors: 0.05 px of each dot and 0.2 px of all. Each contact
is pressed, held, moved, and then read. It takes minutes; simulated.

`--calibrate` prints the factors of kernels/touch/patch.py, and of normal force by shape, that follow from the
seeds, and writes nothing. `make results` puts the tables into docs/touch-maps.md.
"""

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from evetac_cli.cli.workers import compute_on_one_thread

compute_on_one_thread()  # before numpy is loaded: times are those of one core

import numpy as np  # noqa: E402

from evetac_cli.arrays import Flags, Floats  # noqa: E402
from evetac_cli.jobs import Row  # noqa: E402
from evetac_cli.kernels.touch import touch_map  # noqa: E402
from evetac_cli.kernels.touch.dot_motion import CELL_MM, GelLayer  # noqa: E402
from evetac_cli.kernels.touch.patch import SUM_FACTORS, TRACTION_FACTORS  # noqa: E402
from evetac_cli.kernels.touch.touch_map import TouchReading, TouchState  # noqa: E402
from evetac_cli.sim.camera.gel_camera import dot_grid  # noqa: E402
from evetac_cli.sim.setup.plan import named_sensor  # noqa: E402
from evetac_cli.sim.setup.sensor import Sensor  # noqa: E402
from scripts.reproduce.facts import RESULTS, ranges  # noqa: E402
from scripts.reproduce.made_tables import table_of, write  # noqa: E402
from scripts.studies.rows import seeds_of  # noqa: E402
from scripts.studies.touch.contact_maker import SHAPES, ContactMaker, KnownContact, on_coarse_cells  # noqa: E402

OWN_PX, COMMON_PX = 0.05, 0.2  # the tracker's error, see kernels/touch/dot_motion.py
TOUCHED = 0.05  # share of the largest pressure above which a cell is in the true patch
WIDE = ("flat", "ball", "cylinder", "off centre", "twisted", "partial slip")  # at least 5 mm in both directions
SIGMAS = {"68": 1.0, "95": 1.96}
ERRORS = ("force", "torsion", "normal", "centre", "area", "shear", "pressure", "since", "shear_since")
# Estimated over true normal force, by shape: medians of seeds 6000-6049 (--calibrate).
NORMAL_BY_SHAPE = {
    **{"flat": 0.897, "ball": 0.958, "cylinder": 0.932, "edge": 0.966, "two points": 0.957},
    **{"off centre": 0.903, "twisted": 0.953, "partial slip": 0.953},
}
COST_SLICES, COST_SEED = 2000, 6000
FACTORS_TRIED = [round(0.3 * 1.02**step, 3) for step in range(150)]


class Setting(NamedTuple):
    """The given sensor properties, and the dots present."""

    name: str
    layer: GelLayer
    missing: float = 0.0  # share of dots
    print_depth_mm: float = 0.0  # true depth of the dots, independent of the given layer


KNOWN = Setting("known sensor", GelLayer())
SETTINGS = (
    KNOWN,
    Setting("stiffness assumed 20 % too low", GelLayer(shear_modulus_pa=0.8 * 145e3)),
    Setting("stiffness assumed 20 % too high", GelLayer(shear_modulus_pa=1.2 * 145e3)),
    Setting("thickness assumed 20 % too low", GelLayer(height_mm=3.2)),
    Setting("thickness assumed 20 % too high", GelLayer(height_mm=4.8)),
    Setting("a tenth of the dots missing", GelLayer(), 0.1),
    Setting("print 0.5 mm deep, unknown", GelLayer(), print_depth_mm=0.5),
    Setting("print 0.5 mm deep, known", GelLayer(print_depth_mm=0.5), print_depth_mm=0.5),
    Setting("parallax, unknown", GelLayer(lens_mm=math.inf)),
)


def dots_of(sensor: Sensor, finer: int = 1) -> Floats:
    """Return positions at rest (dots, 2) in mm from the axis; `finer` multiplies the number of dots approximately."""
    if finer == 1:
        at_px = dot_grid(sensor, cut=False).reshape(-1, 2)
    else:
        lines = [
            np.linspace(line[0], line[-1], round(len(line) * math.sqrt(finer)))
            for line in (sensor.dot_columns_px, sensor.dot_rows_px)
        ]
        at_px = np.stack(np.meshgrid(*lines), -1).reshape(-1, 2)
    places: Floats = (at_px - np.array(sensor.frame_px) / 2) * sensor.mm_per_px
    return places


def seen(contact: KnownContact, rest_mm: Floats, mm_per_px: float) -> tuple[Floats, Floats, np.random.Generator]:
    """Return the seen dots when pressed and when moved, (dots, 2) in mm, and the generator of further errors."""
    rng = np.random.default_rng([contact.seed, SHAPES.index(contact.shape), 1])
    places = []
    for motion in (contact.pressed_motion_mm, contact.dot_motion_mm):
        own, common = rng.normal(size=rest_mm.shape) * OWN_PX, rng.normal(size=2) * COMMON_PX
        nearer = rest_mm * (motion[:, 2:] / GelLayer().lens_mm)
        places.append(rest_mm + motion[:, :2] + nearer + (own + common) * mm_per_px)
    return places[0], places[1], rng


def read(state: TouchState, contact: KnownContact, setting: Setting, mm_per_px: float) -> TouchReading:
    """Return a touch map's estimate for a contact that was pressed, held and moved, after two renewals."""
    pressed, moved, rng = seen(contact, state.rest_mm, mm_per_px)
    lost: Flags = np.zeros(len(pressed), np.bool_)
    lost[rng.permutation(len(lost))[: round(setting.missing * len(lost))]] = True
    touch_map.step(state, state.rest_mm, lost)  # nothing touches: the earlier state is forgotten
    touch_map.step(state, pressed, lost)
    touch_map.renew(state)
    touch_map.hold(state)
    touch_map.step(state, moved, lost)
    touch_map.renew(state)
    touch_map.renew(state)
    return touch_map.step(state, moved, lost)


def judged(contact: KnownContact, reading: TouchReading, state: TouchState) -> Row:
    """Return a reading's errors, and lists of errors over deviations: of x and y, and of the estimated cells."""
    truth = on_coarse_cells(contact, state.cells.x_mm, state.cells.y_mm)
    shear, pressure, since = truth[:2], truth[2], truth[:2] - truth[3:]
    touched = pressure > TOUCHED * pressure.max()
    area_mm2 = float(touched.sum() * CELL_MM**2)
    net, normal = contact.net_shear_n, contact.normal_n
    torsion = contact.torsion_n_mm(reading.centre_mm)
    since_n = contact.net_since_pressed_n
    cells = reading.patch

    def over(error: Floats, sd: Floats) -> list[float]:
        return [float(one) for one in np.ravel(np.abs(error) / np.maximum(sd, 1e-12))]

    z = {
        "force": over(reading.shear_n - net, reading.shear_sd_n),
        "torsion": over(np.array(reading.torsion_n_mm - torsion), np.array(reading.torsion_sd_n_mm)),
        "normal": over(np.array(reading.normal_n - normal), np.array(reading.normal_sd_n)),
        "centre": over(reading.centre_mm - contact.centre_mm, reading.centre_sd_mm),
        "area": over(np.array(reading.area_mm2 - area_mm2), np.array(reading.area_sd_mm2)),
        "shear": over((reading.shear_pa - shear)[:, cells], reading.shear_sd_pa[:, cells]),
        "pressure": over((reading.pressure_pa - pressure)[cells], reading.pressure_sd_pa[cells]),
        "since": over(reading.shear_since_n - since_n, reading.shear_since_sd_n),
        "shear_since": over((reading.shear_since_pa - since)[:, cells], reading.shear_since_sd_pa[:, cells]),
    }
    return {
        "shape": contact.shape,
        "seed": contact.seed,
        "field": _share(reading.shear_pa - shear, shear),
        "field_since": _share(reading.shear_since_pa - since, since),
        "pressure": _share(reading.pressure_pa - pressure, pressure),
        "net": _share(reading.shear_n - net, net),
        "net_since": _share(reading.shear_since_n - since_n, since_n),
        "force_mae_n": float(np.abs(reading.shear_n - net).mean()),
        "torsion_n_mm": abs(reading.torsion_n_mm - torsion),
        "place_mm": float(np.hypot(*(reading.centre_mm - contact.centre_mm))),
        "area": reading.area_mm2 / area_mm2,
        "iou": float((touched & cells).sum() / (touched | cells).sum()),
        "normal": reading.normal_n / normal,
        "normal_by_shape": reading.normal_n / normal / NORMAL_BY_SHAPE[contact.shape],
        "z": z,
    }


def _share(error: Floats, of: Floats) -> float:
    return float(np.linalg.norm(error) / np.linalg.norm(of))


def contacts_of(maker: ContactMaker, seeds: Iterable[int]) -> list[KnownContact]:
    """Return a contact of each shape and seed; the shapes of a seed follow each other."""
    return [maker.make(shape, seed) for seed in seeds for shape in SHAPES]


def rows_of(setting: Setting, contacts: list[KnownContact], rest_mm: Floats, mm_per_px: float) -> list[Row]:
    """Return a row for each contact, read with the given properties of a setting."""
    state = touch_map.start(rest_mm, setting.layer, renews=False)
    return [judged(contact, read(state, contact, setting, mm_per_px), state) for contact in contacts]


def coverage(rows: list[Row], what: str) -> dict[str, float]:
    """Return the share of errors within one and 1.96 standard deviations; each contact has the same weight."""
    return {
        name: float(np.mean([np.mean(np.array(row["z"][what]) < sigma) for row in rows]))
        for name, sigma in SIGMAS.items()
    }


def summary(name: str, rows: list[Row]) -> Row:
    """Return medians, the mean IoU, and coverage over contacts."""

    def median(key: str) -> float:
        return float(np.median([row[key] for row in rows]))

    wide = [row["iou"] for row in rows if row["shape"] in WIDE]
    shown: Row = {
        "what": name,
        "n": len(rows),
        **{key: median(key) for key in ("field", "field_since", "pressure", "net", "net_since", "torsion_n_mm")},
        "force_mae_n": float(np.mean([row["force_mae_n"] for row in rows])),
        "place_mm": median("place_mm"),
        "place_90_mm": float(np.quantile([row["place_mm"] for row in rows], 0.9)),
        "iou": float(np.mean([row["iou"] for row in rows])),
        "iou_wide": float(np.mean(wide)) if wide else None,
        "normal_bias": median("normal") - 1.0,
        "normal_error": float(np.median([abs(row["normal"] - 1) for row in rows])),
        "normal_by_shape_error": float(np.median([abs(row["normal_by_shape"] - 1) for row in rows])),
    }
    for what in ERRORS:
        shown |= {f"{what}_{name}": value for name, value in coverage(rows, what).items()}
    return shown


def factors(rows: list[Row]) -> dict[str, float]:
    """Return the factor for each deviation that brings its coverage closest to 68 and 95 %."""
    found = {}
    for what in ERRORS:
        each = [np.array(row["z"][what]) for row in rows]
        z = np.concatenate(each)
        weight = np.concatenate([np.full(len(of_row), 1.0 / (len(rows) * len(of_row))) for of_row in each])

        def off(factor: float, z: Floats = z, weight: Floats = weight) -> float:
            return max(
                abs(float(weight[z < sigma * factor].sum()) - float(name) / 100) for name, sigma in SIGMAS.items()
            )

        found[what] = min(FACTORS_TRIED, key=off)
    return found


def cost_rows(sensor: Sensor) -> list[Row]:
    """Return processor time of one core per slice, and per renewal, for 63 and 252 dots and two contacts."""
    rows = []
    for finer, shape, held in itertools.product((1, 4), ("ball", "flat"), (False, True)):
        rest_mm = dots_of(sensor, finer)
        pressed, moved, _ = seen(ContactMaker(rest_mm).make(shape, COST_SEED), rest_mm, sensor.mm_per_px)
        state = touch_map.start(rest_mm, renews=False)
        touch_map.step(state, pressed)
        touch_map.renew(state)
        if held:
            touch_map.hold(state)
        touch_map.step(state, moved)
        touch_map.renew(state)
        times: dict[str, list[float]] = {"slice": [], "renewal": [], "part": []}
        for number in range(COST_SLICES):
            begun = time.process_time()
            touch_map.step(state, moved)
            times["slice"].append(time.process_time() - begun)
            if number % 100 == 0:
                parts, done = [], False
                while not done:
                    begun = time.process_time()
                    done = touch_map.renew_part(state)
                    parts.append(time.process_time() - begun)
                times["renewal"].append(sum(parts))
                times["part"].append(max(parts))
        rows.append(
            {
                "dots": len(rest_mm),
                "shape": shape,
                "held": "yes" if held else "no",
                "patch_cells": int(state.now.fit.patch.sum()) if state.now is not None else 0,
                "slice_us_median": 1e6 * float(np.median(times["slice"])),
                "slice_us_p99": 1e6 * float(np.quantile(times["slice"], 0.99)),
                "renewal_ms_median": 1e3 * float(np.median(times["renewal"])),
                "part_ms_median": 1e3 * float(np.median(times["part"])),
            }
        )
    return rows


ERROR_COLUMNS = {
    "contacts": "{what}",
    "n": "{n}",
    "field": "{field:.2f}",
    "field since held": "{field_since:.2f}",
    "net shear": "{net:.1%}",
    "net shear [N]": "{force_mae_n:.3f}",
    "torsion [N mm]": "{torsion_n_mm:.3f}",
    "place [mm]": "{place_mm:.2f}",
    "place, 90 % [mm]": "{place_90_mm:.2f}",
    "IoU": "{iou:.2f}",
    "normal": "{normal_bias:+.0%}",
    "error of normal, by shape": "{normal_error:.0%}, {normal_by_shape_error:.0%}",
}
COVERAGE_COLUMNS = {
    "contacts": "{what}",
    **{
        heading: f"{{{key}_68:.0%}}, {{{key}_95:.0%}}"
        for heading, key in (
            *(("net shear", "force"), ("torsion", "torsion"), ("normal force", "normal"), ("place", "centre")),
            *(
                ("area", "area"),
                ("cells, shear", "shear"),
                ("cells, pressure", "pressure"),
                ("net shear since held", "since"),
            ),
            ("cells, shear since held", "shear_since"),
        )
    },
}
COST_COLUMNS = {
    "dots": "{dots}",
    "contact": "{shape}",
    "shear since held, too": "{held}",
    "cells in the patch": "{patch_cells}",
    "slice, median [us]": "{slice_us_median:.0f}",
    "slice, 99 % [us]": "{slice_us_p99:.0f}",
    "patch renewed, median [ms]": "{renewal_ms_median:.1f}",
    "its longest part, median [ms]": "{part_ms_median:.1f}",
}


def main() -> None:
    """Measure and write the tables, or print the factors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=seeds_of, default="107000-107024", help="FIRST-LAST; a contact of each shape per seed"
    )
    parser.add_argument("--calibrate", action="store_true", help="print the factors instead")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    seeds = list(chosen.seeds)
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm = dots_of(sensor)
    by_depth = {
        depth_mm: contacts_of(ContactMaker(rest_mm, print_depth_mm=depth_mm), seeds)
        for depth_mm in sorted({setting.print_depth_mm for setting in ([KNOWN] if chosen.calibrate else SETTINGS)})
    }
    contacts = by_depth[0.0]
    known = rows_of(KNOWN, contacts, rest_mm, sensor.mm_per_px)
    if chosen.calibrate:
        by_shape = {
            shape: float(np.median([row["normal"] for row in known if row["shape"] == shape])) for shape in SHAPES
        }
        said = {"factors on those of today": factors(known), "today": [*SUM_FACTORS, *TRACTION_FACTORS]}
        sys.stdout.write(json.dumps({**said, "normal by shape": by_shape, **summary("known", known)}, indent=1) + "\n")
        return
    rows = [summary(KNOWN.name, known)]
    rows += [
        summary(setting.name, rows_of(setting, by_depth[setting.print_depth_mm], rest_mm, sensor.mm_per_px))
        for setting in SETTINGS[1:]
    ]
    rows += [summary(shape, [row for row in known if row["shape"] == shape]) for shape in SHAPES]
    costs = cost_rows(sensor)
    command, sizes = f"python scripts/studies/touch/contacts.py --seeds {ranges(seeds)}", {"contact_seeds": seeds}
    errors = ("touch-contacts", "Errors of touch maps on known contacts", ERROR_COLUMNS, rows)
    covered = ("touch-coverage", "Errors within one and 1.96 deviations", COVERAGE_COLUMNS, rows[: len(SETTINGS)])
    write(chosen.out, *(table_of(*one, command, sizes) for one in (errors, covered)))
    about = ("touch-map-cost", "What a slice and a patch cost", COST_COLUMNS, costs)
    write(chosen.out, table_of(*about, "python scripts/studies/touch/contacts.py", {}))


if __name__ == "__main__":
    main()
