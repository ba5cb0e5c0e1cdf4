"""The parts of a simulated scene: which parts are built, which are left out, and the plan with one part switched.

A scene pays run time only for the parts that it names. The code that builds a part reports it (`built` of a camera and
of a simulation), and this module describes it. The cost of a part is measured on the plans that `switched` returns: the
trial with only this part left out, or with only this part added. A `Timer` measures the time of single calls.
"""

from collections.abc import Callable, Set
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from evetac_cli.sim.setup.held import HandSettings, SecondFingerSettings
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.sampling import gripper_faults
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.sensor import Sensor

MODES = {"ramp": "current mode", "hold": "position, then current mode", "lift": "position mode"}  # of the gripper

Switch = Callable[[Plan], Plan]
Call = TypeVar("Call", bound=Callable[..., Any])


class Timer(Protocol):
    """Measures the calls that belong to a part; code that makes such calls wraps them once and keeps the result."""

    def __call__(self, part: str, call: Call) -> Call:
        """Return the call, wrapped so that its time is counted for the part."""


def untimed(part: str, call: Call) -> Call:
    """Return the call itself: nothing is measured, so it costs nothing."""
    return call


class ScenePart(NamedTuple):
    """A part of a scene: a description of it if it is built, and the reason if it is left out.

    switch: returns the plan without the part, or with it if it is left out; None if the part cannot be switched.
    """

    name: str
    words: str
    why_not: str
    switch: Switch | None = None


def rows_of(plan: Plan) -> list[dict[str, Any]]:
    """Return the parts that a plan builds and those that it leaves out, one row per part."""
    built, parts = _built(plan), parts_of(plan)
    return [
        {
            "part": part.name,
            "built": part.words if part.name in built else None,
            "left_out": None if part.name in built else part.why_not,
        }
        for part in parts
    ]


def switched(plan: Plan) -> dict[str, Plan]:
    """Return, by part, the plan with that part switched: left out if it is built, built if it is left out."""
    built = _built(plan)
    return {
        part.name: part.switch(plan)
        for part in parts_of(plan)
        if part.switch is not None and (part.name in built or part.name in CAN_BE_ADDED)
    }


def _built(plan: Plan) -> Set[str]:
    """Return the parts that the simulation of a plan reports as built."""
    from evetac_cli.sim.scenes.building import simulation_of  # imports numba

    simulation = simulation_of(plan, np.random.SeedSequence(0))
    return simulation.built | simulation.gel_camera.built


def parts_of(plan: Plan) -> list[ScenePart]:
    """Return the descriptions of all parts that a plan may have, built or not."""
    return [*_mechanics(plan), *_camera(plan.scene, plan.sensor), *_disturbances(plan)]


def _mechanics(plan: Plan) -> list[ScenePart]:
    scene, sensor, solver = plan.scene, plan.sensor, plan.scene.solver
    steps = f"{solver.tolerance_um:g} um per step" if solver.step_ms is None else f"{solver.step_ms:g} ms steps"
    friction, creep = sensor.friction, sensor.creep
    spread = f"by {friction.patch_spread or 0.0:.0%} over {friction.patch_mm or 0.0:.3g} mm"
    arms = () if creep is None else zip(creep.share, creep.time_s, strict=True)
    even = replace(friction, patch_spread=None, patch_mm=None)
    driven = scene.kind in ("press", "rub")
    return [
        ScenePart(
            "gel and friction",
            f"nodes every {solver.node_pitch_mm:g} mm, {steps}",
            "nothing slips: each wave has a closed form",
        ),
        ScenePart(
            "friction that varies over the gel",
            spread,
            "nothing slips" if scene.kind == "tone" else "the sensor has none",
            _sensor(friction=even),
        ),
        ScenePart(
            "friction over pressure",
            _pressure_law(plan),
            "nothing slips"
            if scene.kind == "tone"
            else "a face presses evenly"
            if driven
            else "friction grows in proportion",
            _sensor(friction=replace(friction, pressure_exponent=0.0)),
        ),
        ScenePart(
            "slow creep",
            ", ".join(f"{share:.0%} in {time_s:.3g} s" for share, time_s in arms),
            "the sensor has none",
            _sensor(creep=None),
        ),
        ScenePart("what touches", _touching(plan), ""),
        ScenePart("gripper", _gripper(scene), "a hand drives the face"),
        ScenePart(
            "camera of the second finger",
            "" if plan.second is None else f"of the sensor {plan.second.name}",
            "the second finger has no camera",
        ),
        ScenePart("free object", "mass, weight, rotation", "its motion is prescribed"),
        ScenePart("table and hand", "lift", "nothing is lifted"),
        ScenePart(
            "pushes", f"{len(scene.push.at_s) if scene.push else 0} half sines", "the scene has none", _scene(push=None)
        ),
        ScenePart(
            "falling weight", f"{scene.drop.mass_g if scene.drop else 0:g} g", "the scene has none", _scene(drop=None)
        ),
    ]


def _pressure_law(plan: Plan) -> str:
    """Describe how friction depends on pressure."""
    own = plan.sensor.friction.pressure_exponent
    low, high = plan.scene.randomise.pressure_exponent if own is None else (own, own)
    return f"grows as pressure to the power {1 - high:.3g}" + (f" to {1 - low:.3g}" if high > low else "")


def _touching(plan: Plan) -> str:
    scene = plan.scene
    if scene.motion is not None:
        return f"a face, {scene.motion.kind}"
    if scene.rub is not None:
        return f"a {' or a '.join(scene.rub.objects)}, rubbed"
    if scene.tone is not None:
        return f"a speaker, {plan.tone_hz:.4g} Hz for {scene.time.tone_s:g} s"
    return f"object {plan.called}"


def _gripper(scene: Scene) -> str:
    """Describe the commands of a scene's gripper."""
    return MODES.get(scene.kind, "") if scene.gripper.current is None else "current mode, current from the scene"


def _camera(scene: Scene, sensor: Sensor) -> list[ScenePart]:
    from evetac_cli.sim.camera.gel_camera import dot_grid  # imports numba

    cut, texture = scene.gel.cut, scene.texture
    hot_pixels = sensor.hot_pixels + (0 if sensor.hot_pixel_table is None else len(sensor.hot_pixel_table.x_px))
    off = sensor.threshold if sensor.threshold_off is None else sensor.threshold_off
    no_window = "the scene does not show it" if texture is not None else "the scene has no texture"
    limit = 0.0 if sensor.readout is None else sensor.readout.events_per_s
    support_ms = 0.0 if sensor.noise_filter is None else sensor.noise_filter.support_ms
    return [
        ScenePart("camera", f"{1000 * scene.solver.scans_per_ms} scans/s, global hold", ""),
        ScenePart("dots", f"{dot_grid(sensor, cut).size // 2}, evaluated only while they move", ""),
        ScenePart(
            "dots that differ",
            f"radius by {sensor.dot_radius_spread:.0%}, contrast by {sensor.dot_contrast_spread:.0%}",
            "all dots are alike",
            _sensor(dot_radius_spread=0.0, dot_contrast_spread=0.0),
        ),
        ScenePart(
            "window",
            "texture of the object, which moves with it",
            no_window if cut else "a closed gel has no window",
            None if texture is None else _other_window,
        ),
        ScenePart("contact edges", "drawn where they move", "the scene has none", _without_edges),
        ScenePart(
            "cut edge",
            "moves with the gel",
            "the sensor has no visible cut edge" if cut else "a closed gel has no cut",
            _sensor(cut_contrast=0.0),
        ),
        ScenePart("noise", f"{sensor.noise_hz:.3g} Hz per pixel", "the sensor has none", _sensor(noise_hz=0.0)),
        ScenePart(
            "hot pixels",
            f"{hot_pixels}",
            "the sensor has none",
            _sensor(hot_pixels=0, hot_pixel_hz=(), hot_pixel_table=None),
        ),
        ScenePart(
            "noise filter",
            f"drops events without a neighbouring event within {support_ms:.4g} ms",
            "no event is dropped",
            _sensor(noise_filter=None),
        ),
        ScenePart(
            "OFF threshold of its own",
            f"{off:.3g}, ON {sensor.threshold:.3g}",
            "ON and OFF have the same threshold",
            _sensor(threshold_off=None),
        ),
        ScenePart(
            "limit of the readout", f"{limit:,.0f} events per second", "the readout has no limit", _sensor(readout=None)
        ),
        ScenePart(
            "slow pixels",
            f"{sensor.bandwidth_hz:.4g} Hz",
            "pixels follow every change at once",
            _sensor(bandwidth_hz=0.0),
        ),
        ScenePart(
            "bandwidth that falls with light",
            "proportional to brightness",
            "all pixels have the same bandwidth" if sensor.bandwidth_hz else "no pixel is slow",
            _sensor(bandwidth_by_light=False),
        ),
        ScenePart(
            "uneven light",
            f"{sensor.light_gradient:.0%} less in the corners",
            "visible only if bandwidth falls with light" if sensor.light_gradient else "the sensor has none",
            _sensor(light_gradient=0.0),
        ),
        ScenePart(
            "lens distortion",
            "k1 {:.3g}, k2 {:.3g}".format(*sensor.distortion),
            "the sensor has none",
            _sensor(distortion=(0.0, 0.0)),
        ),
        ScenePart("leak", f"{sensor.leak_hz:.4g} Hz per pixel", "the sensor has none", _sensor(leak_hz=0.0)),
        ScenePart(
            "blind pixels",
            f"{sensor.refractory_us:.4g} us after an event",
            "the sensor has none",
            _sensor(refractory_us=0.0),
        ),
    ]


def _disturbances(plan: Plan) -> list[ScenePart]:
    """Return the disturbances, off unless a scene (or for the gripper, its sensor) names them.

    Those without run time have no switch.
    """
    scene, hand = plan.scene, plan.scene.hand
    faults = gripper_faults(scene, plan.sensor)
    second, off, gone, change = (
        scene.gripper.second_finger if plan.second is None else scene.gripper.second_finger or SecondFingerSettings(),
        scene.calibration,
        scene.vanishing_dots,
        scene.friction_change,
    )
    factors = {} if second is None else {"friction": second.friction_factor, "stiffness": second.stiffness_factor}
    low, high = scene.gripper.friction_factor
    own = plan.sensor.gripper
    delay_ms, jitter_ms = faults.command_delay_ms, faults.command_jitter_ms
    late = f"by {delay_ms:.3g} to {delay_ms + jitter_ms:.3g} ms" if jitter_ms else f"by {delay_ms:.3g} ms"
    jerk = hand.jerk
    return [
        ScenePart("changing light", _light(scene), "the light is steady", _scene(light=None)),
        ScenePart(
            "vanishing dots",
            "" if gone is None else f"{len(gone.dots)}, starting at {gone.at_s:g} s",
            "the scene has none",
            _scene(vanishing_dots=None),
        ),
        ScenePart(
            "calibration that is off",
            "" if off is None else "by {:g}, {:g} px and {:g} deg".format(*off.offset_px, off.turned_deg),
            "the calibration is exact",
        ),
        ScenePart(
            "change of friction",
            "" if change is None else f"x {change.factor:g}, starting at {change.at_s:g} s",
            "the scene has none",
            _scene(friction_change=None),
        ),
        ScenePart(
            "gear friction",
            f"x {low:g}" + (f" to {high:g}" if high > low else ""),
            "friction is that of the sensor's gripper",
        ),
        ScenePart(
            "gear that breaks loose",
            f"in motion {own.kinetic_share or 0.0:.0%} of the friction at rest",
            "friction is the same in motion as at rest",
        ),
        ScenePart("backlash of the gripper", f"{faults.backlash_ticks:.3g} ticks", "the gripper has none"),
        ScenePart(
            "second finger of its own",
            ", ".join(f"{name} x {factor:g}" for name, factor in factors.items() if factor != 1.0),
            "it is a mirror image of the first",
            lambda plan: replace(
                _with_scene(plan, gripper=replace(plan.scene.gripper, second_finger=None)), second=None
            ),
        ),
        ScenePart("noise of the gripper's encoder", f"{faults.encoder_noise_ticks:.3g} ticks", "the gripper has none"),
        ScenePart("commands that come late", late, "commands take effect in the next ms"),
        ScenePart(
            "profile of the hand's motion",
            {"s-curve": "an s-curve", "steps": "steps at 125 Hz"}.get(hand.profile, ""),
            "the profile is a trapezoid",
            _hand(profile=HandSettings.profile),
        ),
        ScenePart("vibration of the hand", _vibration(hand), "the scene has none", _hand(vibration=None)),
        ScenePart(
            "jerk of the hand",
            "" if jerk is None else f"{jerk.speed_mm_s:g} mm/s for {jerk.lasts_s:g} s at {jerk.at_s:g} s",
            "the scene has none",
            _hand(jerk=None),
        ),
        ScenePart(
            "other stiffness of the gel", f"x {scene.gel.stiffness_factor:g}", "the stiffness is that of the sensor"
        ),
        ScenePart(
            "other mass of the object",
            f"{scene.object.mass_g if scene.object else 0:g} g",
            "the mass is that of the object",
        ),
    ]


def _light(scene: Scene) -> str:
    if scene.light is None:
        return ""
    flicker, step, flash = scene.light.flicker, scene.light.step, scene.light.flash
    lights = [f"flickers by {flicker.depth:.0%} at {flicker.frequency_hz:g} Hz"] if flicker else []
    lights += [f"x {step.factor:g}, starting at {step.at_s:g} s"] if step else []
    lights += [f"{scene.light.floor:g} does not pass through the print"] if scene.light.floor else []
    lights += [f"flashes every {flash.every_s:g} s"] if flash else []
    return ", ".join(lights)


def _vibration(hand: HandSettings) -> str:
    """Describe the sine waves of a hand's vibration."""
    vibration = hand.vibration
    if vibration is None:
        return ""
    waves = zip(vibration.acceleration_m_s2, vibration.frequency_hz, strict=True)
    listed = ", ".join(f"{acceleration:g} m/s2 at {frequency:g} Hz" for acceleration, frequency in waves)
    return f"{listed}, while it rises" if vibration.only_moving else listed


def _with_scene(plan: Plan, **changes: Any) -> Plan:
    return replace(plan, scene=replace(plan.scene, **changes))


def _scene(**changes: Any) -> Switch:
    return lambda plan: _with_scene(plan, **changes)


def _sensor(**changes: Any) -> Switch:
    return lambda plan: replace(plan, sensor=replace(plan.sensor, **changes))


def _hand(**changes: Any) -> Switch:
    return lambda plan: _with_scene(plan, hand=replace(plan.scene.hand, **changes))


def _other_window(plan: Plan) -> Plan:
    """Return the plan with the texture in the window if it is left out, else without it."""
    scene = plan.scene
    assert scene.texture is not None
    if scene.shows_texture:
        return _with_scene(plan, texture=replace(scene.texture, show=False))
    return _with_scene(plan, texture=replace(scene.texture, show=True), gel=replace(scene.gel, cut=True))


def _without_edges(plan: Plan) -> Plan:
    rub = plan.scene.rub
    return plan if rub is None else _with_scene(plan, rub=replace(rub, edge_log_contrast=(0.0, 0.0)))


CAN_BE_ADDED = ("window",)  # parts that can be added: a texture that the scene names but does not show
