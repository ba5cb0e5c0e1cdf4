"""Scenes of kind `rub`: an object is pressed on the gel, sheared and rubbed over it; its edges cause most events.

The contact area is the inside of the outline that the camera sees: an ellipse (a finger) or a ring (the handle of a
pair of scissors). The outline moves with the object. In all else it is a scene of pressing.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.events import FRAME_PX
from evetac_cli.sim.camera import contact_edges
from evetac_cli.sim.scenes.pressing import NO_HOLE, Pressing, Timeline, covered, timeline
from evetac_cli.sim.setup.parts import Timer, untimed
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import SampledTrial

SIZES_PX = {"finger": (250.0, 180.0), "handle": (260.0, 150.0)}  # size along x and y
THICK_PX = {"finger": None, "handle": 40.0}  # width of the ring; None: no hole
STARTS_PX = ((200.0, 260.0), (60.0, 160.0))  # ranges of the distance from the middle of the view at touch, along x, y
STAYS_PX = (320.0, 240.0)  # largest distance of its middle from the middle of the view, if a rub's direction allows it
DIRECTIONS = 64  # random directions to choose from for each rub
SEEN_FROM_N = 0.2  # normal force above which an object is fully visible


@dataclass(frozen=True)
class SampledRub(SampledTrial):
    """Values that were sampled for one trial: frictions as in all scenes, and the object."""

    object_name: str
    normal_n: float
    edge_log_contrast: float
    edge_blur_px: float


class Rubbing(Pressing):
    """A trial of rubbing: `step` advances by one slice, `truth` returns its ground truth."""

    follows = True

    def __init__(
        self,
        plan: Plan,
        mechanics: np.random.Generator,
        optics_rng: np.random.Generator,
        *,
        timer: Timer = untimed,
    ) -> None:
        """Build the parts that a plan names."""
        rub = plan.scene.rub
        assert rub is not None
        self._rub = rub
        object_name = str(mechanics.choice(rub.objects))
        contrast, blur_px = (float(mechanics.uniform(*ends)) for ends in (rub.edge_log_contrast, rub.edge_blur_px))
        self._normal_n = float(mechanics.uniform(*rub.normal_n))
        self._size_px, self._thick_px = np.array(SIZES_PX[object_name]), THICK_PX[object_name]
        outline = None  # edges without contrast are invisible and not drawn
        if contrast > 0.0:
            outline = contact_edges.ellipse(self._size_px, contrast, blur_px, self._thick_px)
        far_px = np.array(
            [mechanics.uniform(*span) for span in STARTS_PX]
        )  # to one side: the first rub crosses the view
        self._starts_px: Floats = far_px * mechanics.choice([-1.0, 1.0], 2)
        at_px = np.array(FRAME_PX) / 2 + self._starts_px
        super().__init__(plan, mechanics, optics_rng, outline, at_px, timer=timer)
        base: dict[str, Any] = asdict(self.sampled)
        self.sampled = SampledRub(
            **base, object_name=object_name, normal_n=self._normal_n, edge_log_contrast=contrast, edge_blur_px=blur_px
        )

    def _plan_motion(self, rng: np.random.Generator) -> tuple[Floats, Timeline]:
        """Touch, shear to both sides, ease off, rub in random directions with pauses between, lift off."""
        rub = self._rub
        mm_per_px = self.gel_camera.mm_per_px
        place = np.zeros(2)
        entries = [(0.0, place, 0.0), (self._scene.time.rest_s, place, 0.0)]

        def go(to_px: Floats, takes_s: float, force_n: float) -> None:
            entries.append((entries[-1][0] + takes_s, to_px * mm_per_px * 1e-3, force_n))

        go(place, rub.touch_s, self._normal_n)
        angle = rng.uniform(0.0, 2 * np.pi)
        aside = rub.shear_px * np.array([np.cos(angle), np.sin(angle)])
        for to_px, share in ((aside, 0.25), (-aside, 0.5), (place, 0.25)):
            go(to_px, share * rub.shear_s, self._normal_n)
        rub_n = float(rng.uniform(*rub.rub_n))
        go(place, rub.pause_s, rub_n)
        for _ in range(int(rng.integers(rub.count[0], rub.count[1] + 1))):
            length_px = float(rng.uniform(*rub.length_mm)) / mm_per_px
            peak_px_s = float(rng.uniform(*rub.speed_mm_s)) / mm_per_px
            place = place + length_px * _direction(
                self._starts_px + place, length_px, rub.length_mm[1] / mm_per_px, rng
            )
            go(place, 0.5 * np.pi * length_px / peak_px_s, rub_n)
            go(place, rub.pause_s, rub_n)
        go(place, rub.lift_s, 0.0)
        return self._starts_px * mm_per_px * 1e-3, timeline(entries)

    def _weights(self, centre_m: Floats) -> Floats:
        """Return the share of each node's cell inside the outline, (rows, columns)."""
        m_per_px = self.gel_camera.mm_per_px * 1e-3
        half_px, hole_px = self._size_px / 2, NO_HOLE
        if self._thick_px is not None:
            hole_px = half_px - self._thick_px
        nodes = self._gel.node_xy_m
        return covered(nodes, centre_m, half_px * m_per_px, is_round=True, hole_m=hole_px * m_per_px)

    def _borne(self, covered: float) -> float:
        """Return the share of the hand's force on the pad: an object half over the edge is not pressed in deeper."""
        across_px, down_px = self._size_px
        area_px2 = across_px * down_px
        if self._thick_px is not None:
            area_px2 -= (across_px - 2 * self._thick_px) * (down_px - 2 * self._thick_px)
        cells = 0.25 * np.pi * area_px2 * (self.gel_camera.mm_per_px * 1e-3) ** 2 / self._gel.cell_area_m2
        return float(min(covered / cells, 1.0))

    def _strength(self) -> float:
        """Return the visibility of the object: 0 before the hand presses."""
        return min(self._hand_n / SEEN_FROM_N, 1.0)

    def truth(self) -> dict[str, Any]:
        """Return the ground truth at the end of the last slice, by schema path."""
        return {**super().truth(), "truth/contact_edge_events": self.gel_camera.contact_edge_events}


def _direction(from_px: Floats, length_px: float, longest_px: float, rng: np.random.Generator) -> Floats:
    """Return a random direction that keeps the object in view, also in the longest rub after it, or the nearest one."""
    angles = rng.uniform(0.0, 2 * np.pi, DIRECTIONS)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends_px = np.abs(from_px + length_px * directions)
    beyond = np.maximum(ends_px - STAYS_PX, 0.0).sum(axis=1)
    trapped = np.maximum(longest_px - np.linalg.norm(ends_px + STAYS_PX, axis=1), 0.0)
    direction: Floats = directions[int(np.argmin(beyond + trapped))]  # the first that keeps the object in view
    return direction
