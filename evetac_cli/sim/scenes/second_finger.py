"""The pad of the second finger, if it does not mirror the first or has its own camera.

Both fingers press with the same force and hold the same rigid object. The second pad has its own friction and
stiffness, and so its own indentation, contact and shear. Two effects are not simulated. The object does not tip when
one finger carries more than the other, which would shift the pressure along each pad. And if the second sensor is
another one, only its level of friction and its pattern on the gel are used, and its gel ends where the first one's
does.

Its camera sees the pad and the object. The second sensor faces the first: it is the first sensor, rotated by half a
turn about the fingers' long axis, which is x of the image. So motion along x is the same in both images; motion along y
and rotations are reversed. The pad itself is simulated in the coordinates of the first sensor.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel import contact, dots, gel
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.pressure_law import PressureLaw
from evetac_cli.sim.parts import Timer
from evetac_cli.sim.scenes.shared import DotPath, friction_factor, material, press
from evetac_cli.sim.scenes.true_slip import RECENT_MS, GroundTruthSlip
from evetac_cli.sim.setup.held import SecondFingerSettings
from evetac_cli.sim.setup.sensor import Sensor

FACING = np.array([1.0, -1.0])  # from coordinates of the first sensor to those of the second, and back
PART = "camera of the second finger"


class SecondFinger:
    """Friction and stiffness of the second pad, and its pressure."""

    def __init__(
        self, settings: SecondFingerSettings, sensor: Sensor, node_xy_m: Floats, own: Sensor | None = None
    ) -> None:
        """Build the second pad; own: its own sensor. If friction varies over the gel, this pad has its own pattern."""
        self._shear_factor = self.stiffness_factor = settings.stiffness_factor
        self._own = own
        friction = settings.friction_factor
        if own is not None:
            self.stiffness_factor *= own.normal_modulus_pa / sensor.normal_modulus_pa
            friction *= own.static_friction_factor / sensor.static_friction_factor
        varies = friction_factor(sensor if own is None else own, node_xy_m, finger=1)
        even = np.full(node_xy_m.shape[:2], friction)
        self.friction_factor: Floats = even if varies is None else even * varies
        self.indentation_m = 0.0

    def pad(self, first: gel.GelState) -> gel.GelState:
        """Return the second pad's gel, undeformed; it holds the object of the first pad."""
        of_sensor = first.material if self._own is None else material(self._own)
        layer = replace(of_sensor, shear_modulus_pa=of_sensor.shear_modulus_pa * self._shear_factor)
        mass_kg, _, inertia = first.inertia.tolist()
        return gel.start(first.node_xy_m, layer, mass_kg, inertia, 1, friction_factor=self.friction_factor)

    def press(
        self,
        state: gel.GelState,
        curve: contact.ForceCurve,
        closing_ticks: float,
        gaps: CellGaps,
        law: PressureLaw | None,
    ) -> Floats:
        """Return each node's share of the normal force at a closing of the gripper, like `shared.press`."""
        assert curve.second_indentation_m is not None
        self.indentation_m = contact.lookup(curve.second_indentation_m, curve.step_ticks, closing_ticks)
        return press(state, self.indentation_m, gaps, self.friction_factor, law)


class SecondView:
    """The second finger's camera, slice by slice."""

    def __init__(self, camera: GelCamera, pad: gel.GelState, gaps: CellGaps, timer: Timer, pieces: int) -> None:
        """Start the camera; pieces: number of straight pieces of a dot's path in each slice."""
        self.camera = camera
        self._render = timer(PART, camera.render)
        self._pad, self._gaps = pad, gaps
        rest_m, cut_m = camera.rest_m * FACING, camera.cut_rest_m * FACING
        self._at_dots = dots.interpolation(pad.node_xy_m, rest_m)
        self._at_seen = dots.interpolation(pad.node_xy_m, np.concatenate([rest_m, cut_m]))
        self.path = DotPath(pad, self._at_dots, pieces) if pieces > 1 else None
        self._slip = GroundTruthSlip(pad, camera.mm_per_px, camera.window_px)
        self._nearer_at_m = -1.0  # the indentation for which _nearer_m was computed
        self._nearer_m: Floats = np.zeros_like(camera.rest_m)
        self._seen = (self._nearer_m, np.zeros(2), 0.0, camera.cut_rest_m)  # set in the first slice
        self._shear_n = np.zeros(2)
        self.events: Events | None = None  # events of the last slice

    def follow(
        self, pose: Floats, shares: Floats, force_n: float, shear_n: tuple[float, float], still_for: int
    ) -> None:
        """Store the object's pose, and the pressure and shear of the pad, at the end of a slice."""
        self._pad.pose[:] = pose
        self._shear_n = np.array(shear_n) * FACING
        if still_for <= RECENT_MS:
            self._slip.follow(self._pad, shares, force_n)

    def see(self, slices: int, indentation_m: float, object_m: Floats, contrast: float, *, still: bool) -> None:
        """Render slice number `slices`; object_m: displacement of the object in the window, in this image."""
        before_m = self._nearer_m
        if not still:
            moved_m = dots.displacement_at(self._pad, *self._at_seen) * FACING
            count = len(self.camera.rest_m)
            self._seen = (moved_m[:count] + self._nearer(indentation_m), object_m, contrast, moved_m[count:])
        shift_m, object_m, contrast, cut_m = self._seen
        path_m = None if self.path is None else self.path.pieces(before_m * FACING, self._nearer_m * FACING) * FACING
        now_us = slices * SLICE_US
        self.events = self._render(shift_m, object_m, contrast, now_us, path_m, cut_m=cut_m, still=still)

    def _nearer(self, indentation_m: float) -> Floats:
        """Return the shift of the dots as they approach the lens; recomputed only if the indentation has changed."""
        if indentation_m != self._nearer_at_m:
            self._nearer_at_m = indentation_m
            depth_m = dots.field_at(self._gaps.depth_m(indentation_m)[..., None], *self._at_dots)[:, 0]
            self._nearer_m = dots.nearer_by(self.camera.rest_m, depth_m)
        return self._nearer_m

    def truth(self, moved_m: Floats) -> dict[str, Any]:
        """Return the ground truth of this finger; moved_m: the object's motion in coordinates of the first sensor."""
        return {
            "truth/dot_xy_px": self.camera.dot_xy_px.astype(np.float32),
            "truth/object_xy_px": (moved_m * FACING * 1e3 / self.camera.mm_per_px).astype(np.float32),
            **self._slip.truth(),
            "truth/shear_force_n": self._shear_n,
        }
