"""The parts of a simulated scene, in the order in which they are listed for users."""

from typing import Any

from evetac_cli.sim.camera import camera_parts
from evetac_cli.sim.scenes import finger_drive, gel_view, held_object, pads, shared
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene_part import ScenePart

MODULES = (shared, finger_drive, pads, held_object, gel_view, camera_parts)
# All parts that these modules define; those in the camera come last.
PARTS: tuple[type[ScenePart], ...] = tuple(
    part
    for module in MODULES
    for part in vars(module).values()
    if isinstance(part, type) and issubclass(part, ScenePart) and part.__module__ == module.__name__ and part.NAME
)


def rows_of(plan: Plan) -> list[dict[str, Any]]:
    """Return a row per part: the values that describe it if the plan has it, None if it is left out."""
    return [{"part": part.NAME, "built": part.describe(plan)} for part in PARTS]


def switched(plan: Plan) -> dict[str, Plan]:
    """Return, by part, the plan with which the cost of that part is measured: the same plan with the part switched."""
    plans = {part.NAME: part.switched(plan) for part in PARTS}
    return {name: other for name, other in plans.items() if other is not None}
