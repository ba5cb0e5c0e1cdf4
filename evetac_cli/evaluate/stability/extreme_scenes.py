"""Scenes with one extreme or adverse part each, as tables that `evaluate stability` merges into a scene."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.scene_file import merged
from evetac_cli.sim.setup.tables import as_table, read_table

Tables = Mapping[str, Mapping[str, Any]]

# Merged into the scene `slip` for the dot tracker: the weight is handed over from 0.2 to 0.5 s, and the current falls
# from 0.9 s until the object slips. The grip is near its limit from the start, so that slip comes soon.
SLIP_SOON: Tables = {"time": {"longest_s": 2.0}, "gripper": {"start_factor": [1.3, 1.5]}}
SLIPS: dict[str, Tables] = {
    "as usual": {},
    "light flickers at 100 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 100.0, "depth": 0.1}}},
    "light flickers at 120 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 120.0, "depth": 0.1}}},
    "light falls to half at 0.7 s": {"light": {"step": {"at_s": 0.7, "factor": 0.5}}},
    "light rises to twice at 0.7 s": {"light": {"step": {"at_s": 0.7, "factor": 2.0}}},
    "dot grid off by 1 px": {"calibration": {"offset_px": [0.8, 0.6]}},
    "dot grid off by 2 px": {"calibration": {"offset_px": [1.6, 1.2]}},
    "dot grid off by 3 px": {"calibration": {"offset_px": [2.4, 1.8]}},
    "dot grid turned by 1 degree": {"calibration": {"turned_deg": 1.0}},
    "two dots vanish at 0.3 s": {"vanishing_dots": {"dots": [[3, 4], [0, 0]], "at_s": 0.3}},
    "friction falls to a tenth at 0.7 s": {"friction_change": {"at_s": 0.7, "factor": 0.1}},
    "gel 10 times as stiff": {"gel": {"stiffness_factor": 10.0}},
    "gel a tenth as stiff": {"gel": {"stiffness_factor": 0.1}},
    "object of 5 g": {"object": {"mass_g": 5.0}},
    "object of 2 kg": {"object": {"mass_g": 2000.0}},
}

# Merged into the scene `lift`: the fingers touch until 1.5 s, the hand rises from 2 s, balance begins at 5 s.
LIFTS: dict[str, Tables] = {
    "gear friction x0.7": {"gripper": {"friction_factor": 0.7}},
    "gear friction x1.3": {"gripper": {"friction_factor": 1.3}},
    "backlash of 5 ticks": {"gripper": {"backlash_ticks": 5.0}},
    "light flickers at 120 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 120.0, "depth": 0.1}}},
    "light falls to half at 3 s": {"light": {"step": {"at_s": 3.0, "factor": 0.5}}},
    "dot grid off by 3 px": {"calibration": {"offset_px": [2.4, 1.8]}},
    "dot grid turned by 1 degree": {"calibration": {"turned_deg": 1.0}},
    "two dots vanish at 3 s": {"vanishing_dots": {"dots": [[3, 4], [0, 0]], "at_s": 3.0}},
    "friction falls to a tenth at 6 s": {"friction_change": {"at_s": 6.0, "factor": 0.1}},
    "gel 10 times as stiff": {"gel": {"stiffness_factor": 10.0}},
    "gel a tenth as stiff": {"gel": {"stiffness_factor": 0.1}},
    "object of 5 g": {"object": {"mass_g": 5.0}},
    "object of 2 kg": {"object": {"mass_g": 2000.0}},
    "hand jerks by 100 mm/s at 4 s": {"hand": {"jerk": {"at_s": 4.0, "speed_mm_s": 100.0, "lasts_s": 0.05}}},
}
MORE_LIFTS: dict[str, Tables] = {  # with --full
    "gear friction x0.85": {"gripper": {"friction_factor": 0.85}},
    "gear friction x1.15": {"gripper": {"friction_factor": 1.15}},
    "backlash of 2 ticks": {"gripper": {"backlash_ticks": 2.0}},
    "light flickers at 100 Hz by 10 %": {"light": {"flicker": {"frequency_hz": 100.0, "depth": 0.1}}},
    "dot grid off by 1 px": {"calibration": {"offset_px": [0.8, 0.6]}},
}


def merge(plan: Plan, *changes: Tables) -> Plan:
    """Return a plan whose scene has these tables added or replaced; their values may be out of all ranges."""
    scene = as_table(plan.scene)
    for tables in changes:
        scene = merged(scene, tables)
    return replace(plan, scene=read_table(Scene, scene, "evaluate stability"))
