"""What dots show of pressure alone: the grip on an object that does not move opens slowly, and no dot jumps."""

import numpy as np
import pytest

from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.gel import contact, dots, gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.scenes.shared import material, pad, press
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.scene import Solver

SENSOR = one_sensor("evetac")
DEEPEST_M = 0.3e-3
RESTS, OPENS = 100, 400  # slices
CONTACTS = {
    "flat, tilted by 0.2 degrees": ("flat", 1.0, 0.0035),
    "flat, tilted by 0.6 degrees": ("flat", 1.0, 0.0105),
    "cylinder": ("cylinder", 30e-3, 0.0),
    "cylinder, tilted by 0.6 degrees": ("cylinder", 30e-3, 0.0105),
    "sphere": ("sphere", 30e-3, 0.0),
    "narrow sphere, tilted by 0.6 degrees": ("sphere", 10e-3, 0.0105),
}


@pytest.mark.parametrize("friction", [gel.Friction(0.0, 0.0), gel.Friction(0.8, 0.6)], ids=["smooth", "rough"])
@pytest.mark.parametrize("name", CONTACTS)
def test_no_dot_jumps_while_the_grip_opens(name: str, friction: gel.Friction) -> None:
    """Assert that in no slice a dot moves by more than 3 times what the one that moves most does in the median slice.

    The finger opens evenly by 0.75 um a slice, to the end of the contact; an object in the gripper lets go as slowly.
    Nodes leave the contact at its border and let go where friction no longer holds what pressure squeezed aside.
    """
    nodes = pad(Solver(), SENSOR, cut=True)
    grid_px = dot_grid(SENSOR, True).reshape(-1, 2)
    rest_m = (grid_px - np.array(SENSOR.frame_px) / 2) * SENSOR.mm_per_px * 1e-3
    at_dots = dots.interpolation(nodes, rest_m)
    state = gel.start(nodes, material(SENSOR), 0.1, 4e-5)
    gaps = contact.gap_profile(nodes, *CONTACTS[name])
    stiffness = SENSOR.normal_modulus_pa / state.material.height_m * state.cell_area_m2
    stepper = Stepper(Solver())
    still, force_n, seen_px = (0.0, 0.0, 0.0), float(stiffness * gaps.depth_m(DEEPEST_M).sum()), []
    for number in range(RESTS + OPENS):
        indentation_m = DEEPEST_M * min(1.0, (RESTS + OPENS - 1 - number) / OPENS)
        before_n, depth_m = force_n, gaps.depth_m(indentation_m)
        force_n = float(stiffness * depth_m.sum())
        shares = press(state, indentation_m, gaps, None, None)
        stepper.advance(state, shares, (before_n, force_n), still, friction, still)
        nearer_m = dots.nearer_by(rest_m, dots.field_at(depth_m[..., None], *at_dots)[:, 0])
        seen_px.append((dots.displacement_at(state, *at_dots) + nearer_m) * (1e3 / SENSOR.mm_per_px))
    seen = np.array(seen_px[RESTS - 1 :])
    moved_px = np.linalg.norm(np.diff(seen, axis=0), axis=2).max(axis=1)
    assert np.linalg.norm(seen[0], axis=1).max() > 0.5
    assert np.linalg.norm(seen[-1], axis=1).max() < 0.1 * np.linalg.norm(seen[0], axis=1).max()
    assert moved_px.max() < 3 * np.median(moved_px)
