"""The pad of the second finger, where a scene says that it is no mirror image of the first.

Both fingers press with the same force and hold the same rigid object. The second pad has a friction and a stiffness of
its own, and so its own indentation, contact and shear; the camera looks at the first. Left out: that the object tips
where one finger carries more than the other, which would shift pressure along each pad.
"""

from dataclasses import replace

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.gel.pressure_law import PressureLaw
from evetac_cli.sim.scenes.shared import friction_factor, press
from evetac_cli.sim.setup.held import SecondFingerSettings
from evetac_cli.sim.setup.sensor import Sensor


class SecondFinger:
    """Friction and stiffness of the second pad, and how it is pressed."""

    def __init__(self, settings: SecondFingerSettings, sensor: Sensor, node_xy_m: Floats) -> None:
        """Where friction varies over the gel of the sensor, it does otherwise over this one."""
        self.stiffness_factor = settings.stiffness_factor
        varies = friction_factor(sensor, node_xy_m, finger=1)
        even = np.full(node_xy_m.shape[:2], settings.friction_factor)
        self.friction_factor: Floats = even if varies is None else even * varies

    def pad(self, first: gel.GelState) -> gel.GelState:
        """Its gel, undeformed; it holds the object of the first pad."""
        modulus_pa = first.material.shear_modulus_pa * self.stiffness_factor
        material = replace(first.material, shear_modulus_pa=modulus_pa)
        mass_kg, _, inertia = first.inertia.tolist()
        return gel.start(first.node_xy_m, material, mass_kg, inertia, 1, friction_factor=self.friction_factor)

    def press(
        self,
        state: gel.GelState,
        curve: contact.ForceCurve,
        closing_ticks: float,
        gaps: CellGaps,
        law: PressureLaw | None,
    ) -> Floats:
        """Share of each node of its gel in the normal force at a closing of the gripper, as `shared.press`."""
        assert curve.second_indentation_m is not None
        indentation_m = contact.lookup(curve.second_indentation_m, curve.step_ticks, closing_ticks)
        return press(state, indentation_m, gaps, self.friction_factor, law)
