"""Recordings of contacts whose tractions are known, pressed and then moved, and the tracks of their dots; no camera."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.setup.plan import first_plan, one_sensor
from evetac_cli.store.layout.provenance import Recipe
from scripts.studies.touch.contact_maker import ContactMaker, KnownContact
from tests.stages.force.dots_and_forces import write_trial

SENSOR = one_sensor("evetac")
MM_PER_PX, MODULUS_PA = SENSOR.mm_per_px, 145e3  # of the layer that contacts are made on
GRID_PX: NDArray[np.float64] = np.array(dot_grid(SENSOR, cut=False))
SLICES, TOUCHED, SHEARED = 310, 20, 255
LENS_MM = 25.0


def rest_mm() -> NDArray[np.float64]:
    """The dots at rest, (dots, 2) from the axis."""
    return np.asarray((GRID_PX.reshape(-1, 2) - [320, 240]) * MM_PER_PX)


@cache
def _maker() -> ContactMaker:
    return ContactMaker(rest_mm())


@cache
def contact(shape: str = "ball", seed: int = 6000) -> KnownContact:
    """A contact of seeds below 10,000."""
    return _maker().make(shape, seed)


def dots_of(of: KnownContact, slices: int = SLICES) -> NDArray[np.float64]:
    """Where its dots are seen, (slices, dots, 2) in mm: at rest, pressed on at TOUCHED, moved aside at SHEARED."""
    time = np.arange(slices)[:, None, None]
    since = of.dot_motion_mm - of.pressed_motion_mm
    motion = (time >= TOUCHED) * of.pressed_motion_mm + (time >= SHEARED) * since
    return np.asarray(rest_mm() + motion[..., :2] + rest_mm() * motion[..., 2:] / LENS_MM)


def write_contact(
    folder: Path,
    number: int,
    of: KnownContact | None,
    *,
    name: str = "evetac",
    truth: bool = True,
    smaller: int = 1,
    stiffer: float = 1.0,
) -> Path:
    """A recording without events of a contact, or of none, with its truth and the tracks of its dots; their path.

    stiffer: the gel, which moves alike under so many times the force.
    """
    time = np.arange(SLICES)
    if of is None:
        dots_mm, normal_n, shear_n = np.tile(rest_mm(), (SLICES, 1, 1)), np.zeros(SLICES), np.zeros((SLICES, 2))
    else:
        dots_mm, normal_n = dots_of(of), of.normal_n * (time >= TOUCHED)
        pressed_n = of.net_shear_n - of.net_since_pressed_n
        shear_n = (time >= TOUCHED)[:, None] * pressed_n + (time >= SHEARED)[:, None] * of.net_since_pressed_n
    dots_px: Any = (dots_mm / MM_PER_PX + [320, 240]) / smaller
    sensor = replace(SENSOR, shear_modulus_pa=MODULUS_PA * stiffer)
    plan = replace(first_plan("press"), sensor=sensor)
    made = Recipe("recording", 1, plan.parameters(), seed=number, simulated_source=truth)
    frame_px = (640 // smaller, 480 // smaller)
    return write_trial(
        folder,
        made,
        GRID_PX / smaller,
        dots_px.astype(np.float32),
        stiffer * normal_n,
        stiffer * shear_n,
        name,
        frame_px,
    )


def own_sensor(folder: Path, *, stiffer: float = 1.0, smaller: int = 1) -> str:
    """A sensor's file that tells scale, modulus (of the contacts' layer, or so much stiffer) and no creep."""
    path = folder / f"{stiffer}-{smaller}.sensor.toml"
    values = {"mm_per_px": MM_PER_PX * smaller, "shear_modulus_pa": MODULUS_PA * stiffer}
    lines = [f"{key} = {value}" for key, value in values.items()]
    path.write_text("\n".join(['like = "evetac"', *lines, "[creep]", "share = [0.0]", "time_s = [1.0]"]))
    return str(path)
