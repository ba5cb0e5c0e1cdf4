"""Evaluate touch maps after two minutes of adaptation with known forces, on sensors that differ from their description.

    python scripts/touch_adapted.py [--seeds 60000-60024] [--out docs/results]

`touch-adapted`: for each setting of touch_contacts.py, errors on its contacts before and after the map's forces are
adapted (kernels/force/gel_forces.py) on 24 other contacts. These take two minutes at 5 s each, with a force sensor with
0.05 N of noise.

`touch-published`: one sensor, with 219 contacts to adapt on and 219 to evaluate. Normal force is 1 to 20 N and shear is
0 to 4 N, as far as friction allows. The table also has the published errors of a force field from events on one real
sensor after 219 recordings (arXiv 2606.09451, a network of 7.9 million parameters, 100 Hz). The scene differs, so this
is not a comparison of methods.

Additional seeds follow those of --seeds by the hundred. It takes minutes; simulated.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from evetac_cli.cli.workers import compute_on_one_thread

compute_on_one_thread()  # before numpy is loaded

import numpy as np  # noqa: E402
from contact_maker import SHAPES, ContactMaker, KnownContact  # noqa: E402
from results import ranges  # noqa: E402
from script_rows import seeds_of  # noqa: E402
from script_tables import RESULTS, table_of, write  # noqa: E402
from touch_contacts import (  # noqa: E402
    KNOWN,
    SETTINGS,
    Setting,
    contacts_of,
    dots_of,
    judged,
    read,
)

from evetac_cli.arrays import Floats  # noqa: E402
from evetac_cli.jobs import Row  # noqa: E402
from evetac_cli.kernels.force import gel_forces  # noqa: E402
from evetac_cli.kernels.force.gel_forces import ForceErrorModel, KnownForces, Scale, Stiffness  # noqa: E402
from evetac_cli.kernels.touch import touch_map  # noqa: E402
from evetac_cli.kernels.touch.touch_map import TouchReading  # noqa: E402
from evetac_cli.sim.setup.plan import named_sensor  # noqa: E402
from evetac_cli.sim.setup.sensor import Sensor  # noqa: E402

READING_SD_N = 0.05
ADAPTED_ON = 3  # seeds of eight contacts each
CONTACT_S = 5.0
STIFFNESS_LOG_SD = 0.2  # assumed error of the given modulus before adaptation
CALIBRATION, NORMAL_N, SHEAR_N = 219, (1.0, 20.0), (0.0, 4.0)
PUBLISHED = {"x_mae_n": 0.14, "y_mae_n": 0.10, "normal_mae_n": 0.93}  # arXiv 2606.09451, over 4, 4 and 20 N


class Told(NamedTuple):
    """Estimates of touch maps for some contacts: forces over the modulus and deviations in mm2; true forces in N."""

    shear_mm2: Floats  # (n, 2)
    shear_sd_mm2: Floats
    normal_mm2: Floats  # (n,)
    normal_sd_mm2: Floats
    shear_n: Floats
    normal_n: Floats


def told_of(readings: list[TouchReading], contacts: list[KnownContact], modulus_mpa: float) -> Told:
    """Return readings of contacts as inputs of the adaptation."""
    return Told(
        np.array([one.shear_n for one in readings]) / modulus_mpa,
        np.array([one.shear_sd_n for one in readings]) / modulus_mpa,
        np.array([one.normal_n for one in readings]) / modulus_mpa,
        np.array([one.normal_sd_n for one in readings]) / modulus_mpa,
        np.array([one.net_shear_n for one in contacts]),
        np.array([one.normal_n for one in contacts]),
    )


def terms(told: Told) -> tuple[Floats, Floats]:
    """Return terms of shear and normal force of independent contacts: no creep."""
    shear = np.zeros((len(told.normal_n), 2, gel_forces.CREEP_ARMS + 2))
    shear[:, :, 0], shear[:, :, -1] = told.shear_mm2, 1.0
    return shear, gel_forces.normal_terms(told.normal_mm2, told.normal_sd_mm2)


def before_adapting(modulus_mpa: float) -> Scale:
    """Return the weights of a gel whose modulus is given, possibly with an error."""
    arms = gel_forces.CREEP_ARMS
    stiffness = Stiffness(modulus_mpa, STIFFNESS_LOG_SD, np.zeros(arms), np.zeros(arms), np.ones(arms))
    return gel_forces.scale_of(stiffness)


def adapted(scale: Scale, told: Told, rng: np.random.Generator) -> Scale:
    """Return the weights after one force sensor reading in each of the contacts."""
    shear, normal = terms(told)
    count = len(told.normal_n)
    known = KnownForces(
        shear,
        normal,
        told.shear_sd_mm2,
        told.normal_sd_mm2,
        told.shear_n + rng.normal(0.0, READING_SD_N, (count, 2)),
        told.normal_n + rng.normal(0.0, READING_SD_N, count),
        np.arange(count),
        CONTACT_S * np.arange(count),
    )
    return gel_forces.adapt(scale, ForceErrorModel(), known, READING_SD_N)[0]


def forces(scale: Scale, told: Told) -> tuple[Floats, Floats]:
    """Return shear (n, 2) and normal force (n,) in N."""
    shear, normal = terms(told)
    return np.einsum("nak,ak->na", shear, scale.shear), normal @ scale.normal


def readings_of(
    setting: Setting, contacts: list[KnownContact], rest_mm: Floats, mm_per_px: float
) -> tuple[list[TouchReading], list[Row]]:
    """Return the estimates for each contact and their errors."""
    state = touch_map.start(rest_mm, setting.layer, renews=False)
    readings = [read(state, contact, setting, mm_per_px) for contact in contacts]
    rows = [judged(contact, one, state) for contact, one in zip(contacts, readings, strict=True)]
    return readings, rows


def adapted_row(
    setting: Setting, on: list[KnownContact], contacts: list[KnownContact], rest_mm: Floats, mm_per_px: float
) -> Row:
    """Return the errors of a setting before and after adaptation."""
    modulus_mpa = setting.layer.shear_modulus_pa * 1e-6
    told_on = told_of(readings_of(setting, on, rest_mm, mm_per_px)[0], on, modulus_mpa)
    readings, rows = readings_of(setting, contacts, rest_mm, mm_per_px)
    told = told_of(readings, contacts, modulus_mpa)
    first = before_adapting(modulus_mpa)
    after = adapted(first, told_on, np.random.default_rng(on[0].seed))
    row: Row = {"what": setting.name, "n": len(contacts), "adapted_on": len(on)}
    for name, scale in (("before", first), ("after", after)):
        shear_n, normal_n = forces(scale, told)
        off = np.linalg.norm(shear_n - told.shear_n, axis=1)
        row |= {
            f"net_{name}": float(np.median(off / np.linalg.norm(told.shear_n, axis=1))),
            f"force_mae_{name}_n": float(np.abs(shear_n - told.shear_n).mean()),
            f"normal_{name}": float(np.median(np.abs(normal_n / told.normal_n - 1.0))),
            f"normal_mae_{name}_n": float(np.abs(normal_n - told.normal_n).mean()),
        }
    factor = float(after.shear[:, 0].mean()) / modulus_mpa
    row["torsion_after_n_mm"] = float(
        np.median(
            [
                abs(one.torsion_n_mm * factor - contact.torsion_n_mm(one.centre_mm))
                for one, contact in zip(readings, contacts, strict=True)
            ]
        )
    )
    keys = ("torsion_n_mm", "place_mm", "iou")
    return row | {key: float((np.mean if key == "iou" else np.median)([one[key] for one in rows])) for key in keys}


def loaded_contacts(maker: ContactMaker, first_seed: int, count: int) -> list[KnownContact]:
    """Return contacts of all shapes over the published ranges of force."""
    contacts: list[KnownContact] = []
    seed = first_seed
    while len(contacts) < count:
        rng = np.random.default_rng([seed, len(SHAPES)])
        for shape in SHAPES:
            load_n = float(rng.uniform(*NORMAL_N)), float(rng.uniform(*SHEAR_N))
            contacts.append(maker.make(shape, seed, load_n))
        seed += 1
    return contacts[:count]


def published_rows(maker: ContactMaker, first_seed: int, rest_mm: Floats, mm_per_px: float) -> list[Row]:
    """Return mean absolute errors on contacts that were not used for adaptation, and the published ones."""
    modulus_mpa = KNOWN.layer.shear_modulus_pa * 1e-6
    on, contacts = (loaded_contacts(maker, first_seed + 100 * number, CALIBRATION) for number in range(2))
    told_on, told = (told_of(readings_of(KNOWN, of, rest_mm, mm_per_px)[0], of, modulus_mpa) for of in (on, contacts))
    first = before_adapting(modulus_mpa)
    after = adapted(first, told_on, np.random.default_rng(first_seed))
    light = np.linalg.norm(told.shear_n, axis=1) < 0.15 * told.normal_n
    rows: list[Row] = []
    for what, scale in (("not adapted", first), (f"adapted on {CALIBRATION} contacts", after)):
        shear_n, normal_n = forces(scale, told)
        off = np.abs(np.column_stack([shear_n - told.shear_n, normal_n - told.normal_n]))
        for which, chosen in (
            ("all", np.ones(len(light), np.bool_)),
            ("shear at least 0.15 of the normal force", ~light),
            ("less shear", light),
        ):
            x, y, normal = (float(one) for one in off[chosen].mean(axis=0))
            rows.append(
                {
                    "what": f"touch map, {what}",
                    "which": which,
                    "n": int(chosen.sum()),
                    **{"x_mae_n": x, "y_mae_n": y, "normal_mae_n": normal},
                }
            )
    published: Row = {"what": "published, one real sensor [other scene]", "which": "its own", "n": None, **PUBLISHED}
    return [*rows, published]


ADAPTED_COLUMNS = {
    "sensor": "{what}",
    "net shear": "{net_before:.1%}",
    "adapted": "{net_after:.1%}",
    "[N]": "{force_mae_after_n:.3f}",
    "torsion, adapted [N mm]": "{torsion_after_n_mm:.3f}",
    "normal force": "{normal_before:.0%}",
    "normal, adapted": "{normal_after:.0%}",
    "normal, adapted [N]": "{normal_mae_after_n:.2f}",
    "place [mm]": "{place_mm:.2f}",
    "IoU": "{iou:.2f}",
}
PUBLISHED_COLUMNS = {
    "forces by": "{what}",
    "contacts": "{which}",
    "n": "{n}",
    "shear x [N]": "{x_mae_n:.3f}",
    "shear y [N]": "{y_mae_n:.3f}",
    "normal [N]": "{normal_mae_n:.2f}",
}


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=seeds_of, default="60000-60024", help="FIRST-LAST; a contact of each shape per seed"
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    seeds = chosen.seeds
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm, mm_per_px = dots_of(sensor), sensor.mm_per_px
    own = range(seeds[0] + 100, seeds[0] + 100 + ADAPTED_ON)
    makers = {depth: ContactMaker(rest_mm, print_depth_mm=depth) for depth in {one.print_depth_mm for one in SETTINGS}}
    of_depth: dict[float, tuple[list[KnownContact], list[KnownContact]]] = {
        depth: (contacts_of(maker, own), contacts_of(maker, seeds)) for depth, maker in makers.items()
    }
    rows = [adapted_row(setting, *of_depth[setting.print_depth_mm], rest_mm, mm_per_px) for setting in SETTINGS]
    published = published_rows(makers[0.0], seeds[0] + 200, rest_mm, mm_per_px)
    command = f"python scripts/touch_adapted.py --seeds {ranges(seeds)}"
    title, sizes = "Errors after two minutes under known forces", {"contact_seeds": [*seeds, *own]}
    write(chosen.out, table_of("touch-adapted", title, ADAPTED_COLUMNS, rows, command, sizes))
    title, sizes = (
        "Mean absolute errors of net force over 4, 4 and 20 N",
        {"contact_seeds": loaded_seeds(seeds[0] + 200)},
    )
    write(chosen.out, table_of("touch-published", title, PUBLISHED_COLUMNS, published, command, sizes))


def loaded_seeds(first_seed: int) -> list[int]:
    """Return the seeds of the contacts of `published_rows`."""
    each = -(-CALIBRATION // len(SHAPES))
    return [first_seed + 100 * number + one for number in range(2) for one in range(each)]


if __name__ == "__main__":
    main()
