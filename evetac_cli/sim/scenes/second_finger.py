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

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.pressure_law import PressureLaw
from evetac_cli.sim.scenes.shared import friction_factor, material, press
from evetac_cli.sim.setup.held import SecondFingerSettings
from evetac_cli.sim.setup.sensor import Sensor


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
