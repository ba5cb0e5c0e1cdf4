"""The parts of a simulated scene: which parts are built, which are left out, and the plan with one part switched.

A scene pays run time only for the parts that it names. The code that builds a part reports it (`built` of a camera and
of a simulation), and this module lists the keys that name it. The cost of a part is measured on the plans that
`switched` returns: the trial with only this part left out, or with only this part added. A `Timer` measures the time of
single calls.
"""

from collections.abc import Callable, Set
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from evetac_cli.sim.setup.held import HandSettings
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.tables import as_table

MOST_SHOWN = 4  # values of a list; longer ones are not shown

Switch = Callable[[Plan], Plan]
Call = TypeVar("Call", bound=Callable[..., Any])


class Timer(Protocol):
    """Measures the calls that belong to a part; code that makes such calls wraps them once and keeps the result."""

    def __call__(self, part: str, call: Call) -> Call:
        """Return the call, wrapped so that its time is counted for the part."""


def untimed(part: str, call: Call) -> Call:
    """Return the call itself: nothing is measured, so it costs nothing."""
    return call


def rows_of(plan: Plan) -> list[dict[str, Any]]:
    """Return a row per part: the values that describe it if the plan builds it, None if it is left out."""
    built, tables = _built(plan), (as_table(plan.sensor), as_table(plan.scene))
    return [
        {"part": part.name, "built": _values(tables, (part.sensor, part.scene)) if part.name in built else None}
        for part in PARTS
    ]


def switched(plan: Plan) -> dict[str, Plan]:
    """Return, by part, the plan with that part switched: left out if it is built; a texture is added if it is not."""
    built = _built(plan) | ({"window"} if plan.scene.texture is not None else set())
    return {part.name: part.switch(plan) for part in PARTS if part.switch is not None and part.name in built}


def _built(plan: Plan) -> Set[str]:
    """Return the parts that the simulation of a plan reports as built."""
    from evetac_cli.sim.scenes.building import simulation_of  # imports numba

    simulation = simulation_of(plan, np.random.SeedSequence(0))
    return simulation.built | simulation.gel_camera.built


def _values(tables: tuple[dict[str, Any], ...], keys: tuple[tuple[str, ...], ...]) -> str:
    """Return the values of keys of a sensor and a scene, without tables and long lists."""
    found = []
    for table, paths in zip(tables, keys, strict=True):
        for path in paths:
            value: Any = table
            for key in path.split("."):
                value = value.get(key) if isinstance(value, dict) else None
            if not (value is None or isinstance(value, dict) or (isinstance(value, list) and len(value) > MOST_SHOWN)):
                found.append(f"{key} {_shown(value)}")
    return ", ".join(found)


def _shown(value: Any) -> str:
    if isinstance(value, list):
        if len(value) == 2 and value[0] == value[1]:
            return _shown(value[0])  # a range of one number
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class ScenePart(NamedTuple):
    """A part of a scene, and the keys that name it in a sensor's row or a scene's file.

    switch: returns the plan without the part; None if the part cannot be left out alone, or costs no time.
    """

    name: str
    sensor: tuple[str, ...] = ()
    scene: tuple[str, ...] = ()
    switch: Switch | None = None


def _sensor(**changes: Any) -> Switch:
    return lambda plan: replace(plan, sensor=replace(plan.sensor, **changes))


def _friction(**changes: Any) -> Switch:
    return lambda plan: _sensor(friction=replace(plan.sensor.friction, **changes))(plan)


def _scene(table: str = "", **changes: Any) -> Switch:
    """Return a switch of values of the scene, or of one of its tables."""

    def switch(plan: Plan) -> Plan:
        new = {table: replace(getattr(plan.scene, table), **changes)} if table else changes
        return replace(plan, scene=replace(plan.scene, **new))

    return switch


def _other_window(plan: Plan) -> Plan:
    """Return the plan with the texture in the window if it is left out, else without it."""
    scene = plan.scene
    if scene.shows_texture:
        return _scene("texture", show=False)(plan)
    return _scene("gel", cut=True)(_scene("texture", show=True)(plan))


def _mirrored_finger(plan: Plan) -> Plan:
    return replace(_scene("gripper", second_finger=None)(plan), second=None)


_SOLVER = ("solver.node_pitch_mm", "solver.tolerance_um", "solver.step_ms")
_NOISE, _DELAY = "gripper.encoder_noise_ticks", ("gripper.command_delay_ms", "gripper.command_jitter_ms")

PARTS = (
    ScenePart(
        "gel and friction",
        ("shear_modulus_pa", "normal_modulus_pa"),
        ("randomise.static_friction", "randomise.memory_um", *_SOLVER),
    ),
    ScenePart(
        "friction that varies over the gel",
        ("friction.patch_spread", "friction.patch_mm"),
        switch=_friction(patch_spread=None, patch_mm=None),
    ),
    ScenePart(
        "friction over pressure",
        ("friction.pressure_exponent",),
        ("randomise.pressure_exponent",),
        _friction(pressure_exponent=0.0),
    ),
    ScenePart("slow creep", ("creep.share", "creep.time_s"), switch=_sensor(creep=None)),
    ScenePart("what touches", (), ("kind", "face", "rub", "rub.objects", "tone", "tone.frequency_hz")),
    ScenePart("gripper", ("gripper",), ("kind", "gripper")),
    ScenePart("camera of the second finger"),
    ScenePart("free object", (), ("kind",)),
    ScenePart("table and hand", (), ("hand", "hand.height_mm")),
    ScenePart("pushes", (), ("push", "push.lasts_s"), _scene(push=None)),
    ScenePart("falling weight", (), ("drop", "drop.mass_g"), _scene(drop=None)),
    ScenePart("camera", ("threshold", "mismatch", "edge_sigma_px", "log_contrast")),
    ScenePart("dots", ("dot_columns_px", "dot_rows_px", "dot_xy_px", "dot_radius_px")),
    ScenePart(
        "dots that differ",
        ("dot_radius_spread", "dot_contrast_spread"),
        switch=_sensor(dot_radius_spread=0.0, dot_contrast_spread=0.0),
    ),
    ScenePart("window", ("window_px",), ("gel.cut", "texture"), _other_window),
    ScenePart(
        "contact edges", (), ("rub.edge_log_contrast", "rub.edge_blur_px"), _scene("rub", edge_log_contrast=(0.0, 0.0))
    ),
    ScenePart("cut edge", ("cut_contrast", "cut_width_px", "cut_jitter_px"), switch=_sensor(cut_contrast=0.0)),
    ScenePart("noise", ("noise_hz", "noise_on_share", "timestamp_step_us"), switch=_sensor(noise_hz=0.0)),
    ScenePart(
        "hot pixels",
        ("hot_pixels", "hot_pixel_hz", "hot_pixel_table", "hot_pixel_table.rate_hz"),
        switch=_sensor(hot_pixels=0, hot_pixel_hz=(), hot_pixel_table=None),
    ),
    ScenePart("noise filter", ("noise_filter.support_ms",), switch=_sensor(noise_filter=None)),
    ScenePart("OFF threshold of its own", ("threshold_off",), switch=_sensor(threshold_off=None)),
    ScenePart("limit of the readout", ("readout.events_per_s",), switch=_sensor(readout=None)),
    ScenePart("slow pixels", ("bandwidth_hz",), switch=_sensor(bandwidth_hz=0.0)),
    ScenePart("bandwidth that falls with light", ("bandwidth_by_light",), switch=_sensor(bandwidth_by_light=False)),
    ScenePart("uneven light", ("light_gradient",), switch=_sensor(light_gradient=0.0)),
    ScenePart("lens distortion", ("distortion",), switch=_sensor(distortion=(0.0, 0.0))),
    ScenePart("leak", ("leak_hz",), switch=_sensor(leak_hz=0.0)),
    ScenePart("blind pixels", ("refractory_us",), switch=_sensor(refractory_us=0.0)),
    ScenePart("changing light", (), ("light", "light.flicker.depth", "light.step.factor"), _scene(light=None)),
    ScenePart("vanishing dots", (), ("vanishing_dots.dots", "vanishing_dots.at_s"), _scene(vanishing_dots=None)),
    ScenePart("calibration that is off", (), ("calibration.offset_px", "calibration.turned_deg")),
    ScenePart(
        "change of friction", (), ("friction_change.at_s", "friction_change.factor"), _scene(friction_change=None)
    ),
    ScenePart("gear friction", ("gripper.friction_factor",), ("gripper.friction_factor",)),
    ScenePart("gear that breaks loose", ("gripper.kinetic_share",)),
    ScenePart("backlash of the gripper", ("gripper.backlash_ticks",), ("gripper.backlash_ticks",)),
    ScenePart("second finger of its own", (), ("gripper.second_finger",), _mirrored_finger),
    ScenePart("noise of the gripper's encoder", (_NOISE,), (_NOISE,)),
    ScenePart("commands that come late", _DELAY, _DELAY),
    ScenePart("profile of the hand's motion", (), ("hand.profile",), _scene("hand", profile=HandSettings.profile)),
    ScenePart(
        "vibration of the hand", (), ("hand.vibration", "hand.vibration.frequency_hz"), _scene("hand", vibration=None)
    ),
    ScenePart("jerk of the hand", (), ("hand.jerk", "hand.jerk.speed_mm_s"), _scene("hand", jerk=None)),
    ScenePart("other stiffness of the gel", (), ("gel.stiffness_factor",)),
    ScenePart("other mass of the object", (), ("object.mass_g",)),
)
