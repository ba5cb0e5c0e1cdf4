"""Contacts of many gels in balance, without camera and without time: what the network of `--method gel` is trained on.

Each contact has a sensor drawn from the ranges of `randomized` (dots, lens, scale, moduli) and a closed or a cut gel. A
face or a round object presses somewhere and shears in several directions; the layer answers as in sim/gel: what sticks
moves with the object, the rest follows; in some contacts the shear is shared out as in full slip. The dots are then
off by what a tracker errs, and the displacement field is read from them as from a recording's.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import splu

from evetac_cli.arrays import Floats
from evetac_cli.jobs import Progress, silent
from evetac_cli.kernels.gel_layer import Squeeze, moved_by, sheet_stiffness
from evetac_cli.kernels.touch.dot_field import lattice_field
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.camera.lens import Lens
from evetac_cli.sim.gel import contact, dots, gel
from evetac_cli.sim.gel.cell_gaps import cell_samples, gaps_of
from evetac_cli.sim.scenes.shared import pad
from evetac_cli.sim.setup.sampling import sample_sensor
from evetac_cli.sim.setup.sensor import Sensor, SensorRanges
from evetac_cli.sim.setup.solver import Solver

HEIGHT_M = gel.GelMaterial().height_m
SHEARS = 8  # of each contact; the first is none
CUT_SHARE = 0.4  # of the gels
NORMAL_N = (0.3, 25.0)
FRICTION = 1.2  # most shear for each N of normal force
DEEPEST_M = 1.5e-3
FARTHEST_M = 2.5e-3  # a surface that moves by more than half the layer's height is no longer linear
FACE_OFFSET_M, OBJECT_OFFSET_M = 10e-3, 4e-3  # from the middle of the view, at most
RADIUS_M = (8e-3, 60e-3)  # of round objects
TILT_RAD = np.deg2rad(0.4)
SLIPPING_SHARE = 0.4  # of the contacts have some of the shear shared out as in full slip
TRACKER_PX = (0.05, 0.4)  # sd of a dot's error
DOT_SHARE = 0.02  # ... and as a share of its displacement
LEAST_NODES = 4


class Contacts(NamedTuple):
    """Fields on the lattice (n, places, 2) in mm, forces over moduli (n, 3) in mm2, and the sensors."""

    field_mm: Floats
    over_modulus_mm2: Floats
    sensors: list[Sensor]


def sample(
    ranges: SensorRanges,
    count: int,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Contacts:
    """So many contacts of sensors from a row of ranges, SHEARS samples each."""
    fields, forces, sensors = [], [], []
    for number, own in enumerate(rng.spawn(count)):
        sensor = sample_sensor(ranges, own)
        field_mm, over_modulus = one_contact(sensor, own)
        fields.append(field_mm)
        forces.append(over_modulus)
        sensors.append(sensor)
        if number % 100 == 99 or number == count - 1:
            progress(number + 1, count)
    return Contacts(np.concatenate(fields), np.concatenate(forces), sensors)


def one_contact(sensor: Sensor, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Fields and forces over moduli of one contact of a sensor."""
    cut = bool(rng.random() < CUT_SHARE)
    nodes = pad(Solver(), sensor, cut=cut)
    area_m2 = contact.cell_area(nodes)
    stiffness = sensor.normal_modulus_pa / HEIGHT_M * area_m2
    depth_m = _depth(nodes, stiffness, rng)
    while (depth_m > 0).sum() < LEAST_NODES:  # beside the pad
        depth_m = _depth(nodes, stiffness, rng)
    depth_m *= min(1.0, rng.uniform(0.2, 1.0) * DEEPEST_M / depth_m.max())
    normal_n = stiffness * depth_m.sum()
    modulus_ratio = sensor.normal_modulus_pa / sensor.shear_modulus_pa
    squeezed_m, share, held_m2 = _moved(nodes, depth_m, modulus_ratio, rng)
    # shear force (x, y) over modulus, in m, for each m that the object moves along x (first column) and y
    answer_m = share.sum(axis=(0, 1)) * area_m2 / HEIGHT_M
    size_m2 = rng.uniform(0.0, FRICTION, SHEARS) * rng.random(SHEARS) ** 0.3
    size_m2 *= normal_n / sensor.shear_modulus_pa
    size_m2[0] = 0.0
    angle = rng.uniform(0.0, 2 * np.pi, SHEARS)
    moved_m = np.minimum(size_m2 / (answer_m.trace() / 2), FARTHEST_M)[:, None]
    moved_m = moved_m * np.column_stack([np.cos(angle), np.sin(angle)])

    grid_px = dot_grid(sensor, cut).reshape(-1, 2)
    mm_per_px = sensor.mm_per_px
    middle_px = np.array(sensor.frame_px) / 2
    rest_m = (grid_px - middle_px) * mm_per_px * 1e-3
    at_dots = dots.interpolation(nodes, rest_m)
    depth_at_dots = dots.field_at(depth_m[..., None], *at_dots)[:, 0]
    share_at_dots = dots.field_at(share.reshape(*depth_m.shape, 4), *at_dots).reshape(-1, 2, 2)
    spread_m = dots.field_at(squeezed_m, *at_dots) + dots.nearer_by(rest_m, depth_at_dots)
    shift_m = spread_m + np.einsum("dij,nj->ndi", share_at_dots, moved_m)
    lens = Lens.of_sensor(sensor)
    dots_px = grid_px + shift_m * (1e3 / mm_per_px)
    if lens is not None:
        dots_px, grid_px = lens.seen(dots_px), lens.seen(grid_px)
    moved_mm = (dots_px - grid_px) * mm_per_px
    error_mm = mm_per_px * np.exp(rng.uniform(*np.log(TRACKER_PX)))
    moved_mm = moved_mm * (1 + DOT_SHARE * rng.normal(size=(1, len(grid_px), 1)))
    moved_mm = moved_mm + rng.normal(0.0, error_mm, moved_mm.shape)
    tracked = np.ones(moved_mm.shape[:2], np.bool_)
    field_mm = lattice_field(moved_mm, (grid_px - middle_px) * mm_per_px, tracked)
    normal_mm2 = np.full(SHEARS, 1e6 * normal_n / sensor.normal_modulus_pa)
    return field_mm, np.column_stack([1e6 * (moved_m @ answer_m.T + held_m2), normal_mm2])


def _depth(nodes: Floats, stiffness: float, rng: np.random.Generator) -> Floats:
    """Indentation (rows, columns) in m by a face (large, rectangle, disc) or a flat, cylinder or sphere."""
    kind = rng.choice(["large", "rectangle", "disc", "object", "object"])
    normal_n = float(np.exp(rng.uniform(*np.log(NORMAL_N))))
    offset_m = OBJECT_OFFSET_M if kind == "object" else FACE_OFFSET_M
    from_middle = nodes - rng.uniform(-offset_m, offset_m, 2)
    if kind == "object":
        shape = rng.choice(["flat", "cylinder", "sphere"])
        radius_m, tilt = float(np.exp(rng.uniform(*np.log(RADIUS_M)))), float(rng.uniform(-TILT_RAD, TILT_RAD))
        points = cell_samples(from_middle)
        height = contact.surface(points, shape, radius_m, tilt)
        if rng.random() < 0.5:  # an object that ends within the view
            ends = (np.abs(points) > rng.uniform(5e-3, 20e-3, 2)).any(axis=-1)
            height = np.where(ends, np.inf, height)
        gaps = gaps_of(height - height.min() if np.isfinite(height).any() else height)
        return gaps.depth_m(gaps.indentation_m(normal_n / stiffness, DEEPEST_M))
    pitch_m = np.sqrt(contact.cell_area(nodes))
    if kind == "disc":
        inside_m = rng.uniform(4e-3, 12e-3) - np.linalg.norm(from_middle, axis=2)
    else:
        half_m = np.array([15e-3, 15e-3]) if kind == "large" else rng.uniform(4e-3, 15e-3, 2)
        inside_m = (half_m - np.abs(from_middle)).min(axis=2)
    weights = np.clip(inside_m / pitch_m + 0.5, 0.0, 1.0)
    depth_m: Floats = weights * (normal_n / (stiffness * max(weights.sum(), 1.0)))
    return depth_m


def _moved(
    nodes: Floats, depth_m: Floats, modulus_ratio: float, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Displacement of each node as the object is pressed in, (rows, columns, 2) in m, and as it moves aside.

    The latter is (rows, columns, 2, 2): along x and y, for each m of the object along x (the last 0) and y. What bears
    a load sticks; in some contacts it slips to a part, in all directions alike. modulus_ratio: normal over shear. The
    third is (2,), the force over the shear modulus, in m2, that holds the object against what pressure squeezes.
    """
    area_m2 = contact.cell_area(nodes)
    squeezed_m2 = Squeeze(nodes, HEIGHT_M).of(modulus_ratio * area_m2 / HEIGHT_M * depth_m)
    moved = moved_by(nodes, HEIGHT_M, depth_m > 0, squeezed_m2)
    if rng.random() < SLIPPING_SHARE:
        count = depth_m.size
        pushed = np.zeros((4 * count, 3))
        pushed[: 2 * count, 0] = np.moveaxis(squeezed_m2, 2, 0).ravel()
        pushed[:count, 1] = pushed[count : 2 * count, 2] = depth_m.ravel()
        slipping = splu(sheet_stiffness(nodes, HEIGHT_M).tocsc()).solve(pushed)[: 2 * count]
        slipping = slipping.reshape(2, *depth_m.shape, 3).transpose(1, 2, 0, 3)
        for axis in (0, 1):
            slipping[..., 1 + axis] *= moved[..., axis, 1 + axis].sum() / slipping[..., axis, 1 + axis].sum()
        moved += rng.random() * (slipping - moved)
    squeezed_m, share = np.ascontiguousarray(moved[..., 0]), np.ascontiguousarray(moved[..., 1:])
    held_m2: Floats = squeezed_m.sum(axis=(0, 1)) * area_m2 / HEIGHT_M - squeezed_m2.sum(axis=(0, 1))
    return squeezed_m, share, held_m2
