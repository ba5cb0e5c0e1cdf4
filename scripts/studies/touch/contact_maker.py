"""Simulated contacts with known tractions in every cell, to evaluate touch maps; they have their own layer model.

There are eight shapes of pressure on cells of 0.5 mm (layer.py). The object is pressed in, then moved or turned
in steps. In each step friction is solved: no cell bears more shear than friction allows, and a cell that bears less
sticks. All properties of a contact are drawn from its seed. The inverse (kernels/touch) uses none of this code.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from evetac_cli.arrays import Flags, Floats
from scripts.studies.touch.layer import CELL_MM, ElasticLayer, SurfaceAnswer

SHAPES = ("flat", "ball", "cylinder", "edge", "two points", "off centre", "twisted", "partial slip")
COUNT = 56  # cells along a side of the contact lattice
FIRST_MM = -(COUNT - 1) / 2 * CELL_MM
CELL_MM2 = CELL_MM**2
N_PER_PA = CELL_MM2 * 1e-6  # force on a cell
LEAST_N, MOST_N = 1.0, 10.0
FRICTION = (0.6, 1.0)
LOADED = (0.2, 0.9)  # share of the friction limit that the motion would reach if all cells stuck
NEARLY_SLIPPING = (0.7, 0.95)
STEPS = 4
CONVERGED = 1e-5  # change per iteration, over the largest traction
MOST_ITERATIONS = 1000
STICKS = 0.999  # share of the friction limit below which a cell sticks


@dataclass(frozen=True)
class KnownContact:
    """A contact and its truth: tractions on its cells, forces, and displacements of the dots.

    cell_mm: (n, 2). shear_pa, pressed_shear_pa: (2, n), after the motion and when only pressed. pressure_pa, sticks:
    (n,). dot_motion_mm, pressed_motion_mm: (dots, 3), along x and y and into the layer.
    """

    shape: str
    seed: int
    cell_mm: Floats
    pressure_pa: Floats
    shear_pa: Floats
    pressed_shear_pa: Floats
    sticks: Flags
    dot_motion_mm: Floats
    pressed_motion_mm: Floats

    @property
    def normal_n(self) -> float:
        """Normal force, in N."""
        return float(self.pressure_pa.sum() * N_PER_PA)

    @property
    def net_shear_n(self) -> Floats:
        """Shear force along x and y, in N."""
        net: Floats = self.shear_pa.sum(axis=1) * N_PER_PA
        return net

    @property
    def net_since_pressed_n(self) -> Floats:
        """Change of the shear force since the contact was only pressed, in N."""
        net: Floats = (self.shear_pa - self.pressed_shear_pa).sum(axis=1) * N_PER_PA
        return net

    @property
    def centre_mm(self) -> Floats:
        """Centre of pressure, in mm."""
        centre: Floats = self.pressure_pa @ self.cell_mm / self.pressure_pa.sum()
        return centre

    def torsion_n_mm(self, about_mm: Floats) -> float:
        """Return the torque of the shear about a point, from x towards y."""
        arm = self.cell_mm - about_mm
        return float((arm[:, 0] * self.shear_pa[1] - arm[:, 1] * self.shear_pa[0]).sum() * N_PER_PA)


def frictional_shear(
    answer: Floats, squeeze: Floats, pressure_pa: Floats, friction: float, path_mm: list[Floats]
) -> tuple[list[Floats], bool]:
    """Return the shear on the cells of a contact after each step of the object, and whether all steps converged.

    - answer: (2 n, 2 n) displacement of cells per shear, mm per Pa, symmetric;
    - squeeze: (2 n,) their displacement under the pressure (n,) in mm;
    - path_mm: positions of the object's points over the cells, (2 n,) each.

    The shear minimises energy within friction times pressure, by accelerated projected gradient. Cells that slide in a
    step continue from there.
    """
    limit = friction * pressure_pa
    cells = len(pressure_pa)
    step = 1.0 / _largest(answer)
    shear, slid_mm, converged = np.zeros(2 * cells), np.zeros(2 * cells), True
    shears = []
    for place_mm in path_mm:
        wanted = squeeze - (place_mm - slid_mm)
        ahead, momentum = shear, 1.0
        for _ in range(MOST_ITERATIONS):
            moved = (ahead - step * (answer @ ahead + wanted)).reshape(2, cells)
            size = np.hypot(*moved)
            moved *= np.minimum(1.0, limit / np.maximum(size, 1e-300))
            after = moved.ravel()
            change = after - shear
            if change @ (ahead - after) > 0:  # overshoots: restart from here
                momentum = 1.0
            grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            ahead, shear = after + (momentum - 1) / grown * change, after
            momentum = grown
            if np.abs(change).max() < CONVERGED * np.abs(shear).max():
                break
        else:
            converged = False
        slid_mm = place_mm - answer @ shear - squeeze
        shears.append(shear)
    return shears, converged


def _largest(matrix: Floats) -> float:
    """Return an upper bound of the largest eigenvalue of a symmetric response matrix: its largest absolute row sum."""
    return float(np.abs(matrix).sum(axis=1).max())


class ContactMaker:
    """Makes contacts on one layer, seen by dots at given positions (dots, 2) in mm from the optical axis."""

    def __init__(
        self,
        dot_mm: Floats,
        layer: ElasticLayer = ElasticLayer(),  # noqa: B008 - immutable
        print_depth_mm: float = 0.0,
    ) -> None:
        """Solve the layer once, which takes a second. print_depth_mm: depth of the dots below the surface."""
        answer = SurfaceAnswer(layer)
        line = FIRST_MM + CELL_MM * np.arange(COUNT)
        self.cell_mm = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        at_dots = SurfaceAnswer(layer, print_depth_mm) if print_depth_mm else answer
        self._at_dots = at_dots.at(dot_mm, FIRST_MM, COUNT).reshape(len(dot_mm), 3, 3, -1)
        self._between = answer.between_cells(COUNT)

    def cell_answer(self, mask: Flags) -> Floats:
        """Return the response of some cells (n of all) to tractions on them: (3, 3, n, n) in mm per Pa."""
        row, column = np.divmod(np.nonzero(mask)[0], COUNT)
        apart = (row[:, None] - row + COUNT - 1, column[:, None] - column + COUNT - 1)
        between: Floats = self._between[:, :, apart[0], apart[1]]
        return between

    def make(self, shape: str, seed: int, load_n: tuple[float, float] | None = None) -> KnownContact:
        """Return the contact of a shape and a seed: 1 to 10 N, friction 0.6 to 1; RuntimeError if it does not converge.

        load_n: normal force and shear, instead of random ones; shear is limited to 0.95 of the friction limit.
        """
        rng = np.random.default_rng([seed, SHAPES.index(shape)])
        profile = pressure_profile(shape, self.cell_mm, rng)
        normal_n = np.exp(rng.uniform(np.log(LEAST_N), np.log(MOST_N)))
        friction, loaded, way = rng.uniform(*FRICTION), rng.uniform(*LOADED), rng.uniform(0.0, 2 * np.pi)
        if shape == "partial slip":
            loaded = rng.uniform(*NEARLY_SLIPPING)
        if load_n is not None:
            normal_n, loaded = load_n[0], min(load_n[1] / (friction * load_n[0]), NEARLY_SLIPPING[1])
        is_pressed = profile > 0
        cells, pressure = self.cell_mm[is_pressed], profile[is_pressed]
        pressure *= normal_n / (pressure.sum() * N_PER_PA)
        count = len(cells)
        between = self.cell_answer(is_pressed)
        answer = np.block([[between[0, 0], between[0, 1]], [between[1, 0], between[1, 1]]])
        answer = (answer + answer.T) / 2
        squeeze = np.concatenate([between[0, 2], between[1, 2]]) @ pressure

        arm = cells - pressure @ cells / pressure.sum()
        along = np.repeat([np.cos(way), np.sin(way)], count)
        turn = np.concatenate([-arm[:, 1], arm[:, 0]])
        rigid_load = (
            np.linalg.solve(answer, np.stack([along, turn], axis=1)) * N_PER_PA
        )  # N and N mm, per mm and per rad
        most_n = loaded * friction * normal_n
        path = most_n / (along @ rigid_load[:, 0]) * along
        if shape == "twisted":
            lever_mm = pressure @ np.hypot(*arm.T) / pressure.sum()
            path = 0.3 * path + rng.choice([-1, 1]) * most_n * lever_mm / (turn @ rigid_load[:, 1]) * turn
        steps = [share * path for share in np.linspace(0.0, 1.0, STEPS + 1)]
        shears, converged = frictional_shear(answer, squeeze, pressure, friction, steps)
        if not converged:
            raise RuntimeError(f"friction did not converge for contact {shape}, seed {seed}")
        shear, pressed = (each.reshape(2, count) for each in (shears[-1], shears[0]))
        seen, seen_pressed = (
            np.einsum("doic,ic->do", self._at_dots[..., is_pressed], np.stack([*each, pressure]))
            for each in (shear, pressed)
        )
        sticks = np.hypot(*shear) < STICKS * friction * pressure
        return KnownContact(shape, seed, cells, pressure, shear, pressed, sticks, seen, seen_pressed)


def pressure_profile(shape: str, cell_mm: Floats, rng: np.random.Generator) -> Floats:
    """Return the pressure (n,) of a shape on cells (n, 2), of any scale, with random position and angle."""
    centre = rng.uniform(-1.5, 1.5, 2)
    angle = rng.uniform(0.0, np.pi)
    if shape == "off centre":
        centre = rng.uniform([5.0, 2.5], [7.0, 4.5]) * rng.choice([-1, 1], 2)
    away = cell_mm - centre
    x = away[:, 0] * np.cos(angle) + away[:, 1] * np.sin(angle)
    y = away[:, 1] * np.cos(angle) - away[:, 0] * np.sin(angle)
    r = np.hypot(x, y)
    profiles: dict[str, Callable[[], Floats]] = {
        "flat": lambda: np.minimum(_inside(5 - np.abs(x)), _inside(5 - np.abs(y))),
        "ball": lambda: _bowl(r / 4.5),
        "cylinder": lambda: _bowl(x / 3) * (np.abs(y) < 7),
        "edge": lambda: np.sqrt(_bowl(x / 0.85)) * (np.abs(y) < 6),
        "two points": lambda: _bowl(np.hypot(x - 4, y) / 2.2) + 0.7 * _bowl(np.hypot(x + 4, y) / 2.2),
        "off centre": lambda: _bowl(r / 4),
        "twisted": lambda: _inside(5 - r),
        "partial slip": lambda: _bowl(r / 5),
    }
    return profiles[shape]()


def _bowl(x: Floats) -> Floats:
    """Return a parabola that is 0 beyond 1: pressure under a round object on a nearly incompressible layer."""
    bowl: Floats = np.maximum(1 - x * x, 0.0)
    return bowl


def _inside(depth_mm: Floats) -> Floats:
    """Return 1 inside a flat face, falling to 0 over the last 0.7 mm."""
    inside: Floats = np.clip(depth_mm / 0.7, 0.0, 1.0)
    return inside


def on_coarse_cells(contact: KnownContact, x_mm: Floats, y_mm: Floats) -> Floats:
    """Return mean tractions (5, rows, columns) in Pa on cells of 1 mm with these centres: means over four fine cells.

    These are shear x, y, pressure, and shear x, y when only pressed; tractions outside the coarse cells are left out.
    """
    coarse_mm = x_mm[1] - x_mm[0]
    column = np.rint((contact.cell_mm[:, 0] - x_mm[0]) / coarse_mm).astype(int)
    row = np.rint((contact.cell_mm[:, 1] - y_mm[0]) / coarse_mm).astype(int)
    inside = (row >= 0) & (row < len(y_mm)) & (column >= 0) & (column < len(x_mm))
    values = np.concatenate([contact.shear_pa, contact.pressure_pa[None], contact.pressed_shear_pa])
    total = np.zeros((5, len(y_mm), len(x_mm)))
    for kind, value in zip(total, values, strict=True):
        np.add.at(kind, (row[inside], column[inside]), value[inside] * (CELL_MM / coarse_mm) ** 2)
    return total
