"""The parts of a simulated scene: which of them a plan builds, which it leaves out, and the same plan the other way.

A scene pays only for what it names. What a part costs, or would cost, is measured on the plan that `switched` makes:
the trial with just this part left out, or with just this part built.
"""

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

from evetac_cli.sim.sampling import GRIPPER_FAULTS, gripper_faults
from evetac_cli.sim.solver import from_scene

Plan = dict[str, Any]

MODES = {"ramp": "current mode", "hold": "position, then current mode", "lift": "position mode"}  # where it grips
DOT_SPREADS = ("dot_radius_spread", "dot_contrast_spread")


class Part(NamedTuple):
    """A part of a scene: what is built of it ("" where it is left out), why it is left out, how to have it otherwise.

    switch: leaves the part out of a plan, or builds it there; None where a scene cannot be had otherwise.
    """

    name: str
    built: str
    why_not: str
    switch: Callable[[Plan], None] | None = None


def parts(plan: Plan) -> list[dict[str, Any]]:
    """What a plan builds and what it leaves out, a row a part."""
    return [
        {"part": part.name, "built": part.built or None, "left_out": None if part.built else part.why_not}
        for part in _table(plan)
    ]


def switched(plan: Plan) -> dict[str, Plan]:
    """The plan with one part the other way, by part: left out where it is built, built where it is left out."""
    changed = {}
    for part in _table(plan):
        if part.switch is not None:
            changed[part.name] = copy.deepcopy(plan)
            part.switch(changed[part.name])
    return changed


def _table(plan: Plan) -> list[Part]:
    return [*_mechanics(plan), *_camera(plan), *_disturbances(plan)]


def _mechanics(plan: Plan) -> list[Part]:
    resolved = plan["scene"]
    kind = resolved["kind"]
    gripped = kind in MODES
    settings = from_scene(resolved)
    steps = f"{settings.tolerance_um:g} um a step" if settings.step_ms is None else f"{settings.step_ms:g} ms steps"
    nodes = "" if kind == "tone" else f"nodes every {settings.node_pitch_mm:g} mm, {steps}"
    touching = f"object {plan['object']}"
    if kind == "press":
        touching = f"a face, {resolved['motion']['kind']}"
    elif kind == "rub":
        touching = f"a {' or a '.join(resolved['rub']['objects'])}, rubbed"
    elif kind == "tone":
        touching = f"a speaker, {plan['tone_hz']:.4g} Hz for {resolved['time']['tone_s']:g} s"
    pushes = f"{len(resolved['push']['at_s'])} half sines" if "push" in resolved else ""
    weight = f"{resolved['drop']['mass_g']} g" if "drop" in resolved else ""
    rubs = plan["sensor_row"].get("friction", {}) if kind != "tone" else {}
    spread = rubs.get("patch_spread", 0.0)
    patches = f"by {spread:.0%} over {rubs['patch_mm']:.3g} mm" if spread and "patch_mm" in rubs else ""
    return [
        Part("gel and friction", nodes, "nothing slips: a closed form for each wave"),
        Part(
            "friction that varies over the gel",
            patches,
            "nothing slips" if kind == "tone" else "the sensor has none",
            _even_friction if patches else None,
        ),
        Part(
            "slow creep",
            _creep(plan["sensor_row"]),
            "the sensor has none",
            _without_creep if _creep(plan["sensor_row"]) else None,
        ),
        Part("what touches", touching, ""),
        Part("gripper", _gripper(resolved), "a hand drives the face"),
        Part("free object", "mass, weight, rotation" if gripped else "", "its motion is prescribed"),
        Part("table and hand", "lift" if kind == "lift" else "", "nothing is lifted"),
        Part("pushes", pushes, "none named", _without("push") if pushes else None),
        Part("falling weight", weight, "none named", _without("drop") if weight else None),
    ]


def _gripper(resolved: Plan) -> str:
    """How the gripper of a scene is commanded; "" where there is none."""
    if "current" in resolved.get("gripper", {}):
        return "current mode, as the scene names it"
    return MODES.get(resolved["kind"], "")


def _camera(plan: Plan) -> list[Part]:
    from evetac_cli.sim.camera.gel_camera import dot_grid  # brings numba

    resolved, sensor_row = plan["scene"], plan["sensor_row"]
    cut = resolved["gel"]["cut"]
    dots = dot_grid(sensor_row, cut).size // 2
    readout = {"dvxplorer": "5000 scans/s, global hold", "ideal": "every event to the us"}[plan["readout"]]
    textured = "texture" in resolved
    shown = cut and textured and resolved["texture"].get("show", True)
    no_window = "nobody looks at it" if textured else "nothing behind it has texture"
    rubbed = resolved["kind"] == "rub" and resolved["rub"]["edge_log_contrast"][1] > 0.0
    cut_edge = cut and sensor_row.get("cut_contrast", 0.0) > 0.0
    hot_pixels = sensor_row["hot_pixels"] + len(sensor_row.get("hot_pixel_table", {}).get("x_px", ()))
    noisy = sensor_row["noise_hz"] > 0.0 or hot_pixels > 0
    noise = f"{sensor_row['noise_hz']:.3g} Hz a pixel, {hot_pixels} hot pixels"
    by_light = sensor_row.get("bandwidth_by_light", False) and sensor_row.get("bandwidth_hz", 0.0) > 0.0
    sizes, inks = (sensor_row.get(key, 0.0) for key in DOT_SPREADS)
    gradient, distortion = sensor_row.get("light_gradient", 0.0), sensor_row.get("distortion", [0.0, 0.0])
    return [
        Part("camera", readout, ""),
        Part("dots", f"{dots}, evaluated while they move", ""),
        Part(
            "dots that differ",
            f"radius by {sizes:.0%}, contrast by {inks:.0%}" if sizes or inks else "",
            "all dots are alike",
            _without_sensor(*(key for key in DOT_SPREADS if key in sensor_row)) if sizes or inks else None,
        ),
        Part(
            "window",
            "texture of the object, moved with it" if shown else "",
            no_window if cut else "closed gel: it has no window",
            (_hide_texture if shown else _show_texture) if textured else None,
        ),
        Part("contact edges", "where they move" if rubbed else "", "none named", _no_edges if rubbed else None),
        Part(
            "cut edge",
            "moves with the gel" if cut_edge else "",
            "the sensor's cut is not seen" if cut else "closed gel: no cut",
            _without_sensor("cut_contrast") if cut_edge else None,
        ),
        Part(
            "noise",
            noise if noisy else "",
            "a camera without noise",
            _without_noise if noisy else None,
        ),
        Part(
            "OFF threshold of its own",
            f"{sensor_row['threshold_off']:.3g}, ON {sensor_row['threshold']:.3g}"
            if "threshold_off" in sensor_row
            else "",
            "as that of ON",
            _unnamed_in_sensor("threshold_off") if "threshold_off" in sensor_row else None,
        ),
        Part(
            "limit of the readout",
            f"{sensor_row['readout']['events_per_s']:,.0f} events a second" if "readout" in sensor_row else "",
            "as fast as events come",
            _unnamed_in_sensor("readout") if "readout" in sensor_row else None,
        ),
        _pixels("slow pixels", sensor_row, "bandwidth_hz", "Hz", "as fast as anything moves"),
        Part(
            "bandwidth that falls with light",
            "proportional to brightness" if by_light else "",
            "one bandwidth of all pixels" if sensor_row.get("bandwidth_hz", 0.0) else "no pixel is slow",
            _unnamed_in_sensor("bandwidth_by_light") if by_light else None,
        ),
        Part(
            "uneven light",
            f"{gradient:.0%} less in the corners" if by_light and gradient else "",
            "seen only where bandwidth falls with light" if gradient else "the sensor has none",
            _without_sensor("light_gradient") if by_light and gradient else None,
        ),
        Part(
            "lens distortion",
            f"k1 {distortion[0]:.3g}, k2 {distortion[1]:.3g}" if any(distortion) else "",
            "the sensor has none",
            _unnamed_in_sensor("distortion") if any(distortion) else None,
        ),
        _pixels("leak", sensor_row, "leak_hz", "Hz a pixel", "the sensor has none"),
        _pixels("blind pixels", sensor_row, "refractory_us", "us after an event", "the sensor has none"),
    ]


def _pixels(name: str, sensor_row: Plan, key: str, unit: str, why_not: str) -> Part:
    """A property of the camera's pixels that a sensor has if its row names it."""
    value = sensor_row.get(key, 0.0)
    return Part(name, f"{value:.4g} {unit}" if value else "", why_not, _without_sensor(key) if value else None)


def _disturbances(plan: Plan) -> list[Part]:
    """What is off unless a scene, or of a gripper its sensor's row, names it."""
    resolved = plan["scene"]
    faults = gripper_faults(resolved, plan["sensor_row"] if resolved["kind"] in MODES else {})
    light, gripper, hand = (resolved.get(group, {}) for group in ("light", "gripper", "hand"))
    flicker, step, jerk = light.get("flicker"), light.get("step"), hand.get("jerk")
    lights = [f"flickers by {flicker['depth']:.0%} at {flicker['frequency_hz']:g} Hz"] if flicker else []
    lights += [f"x {step['factor']:g} from {step['at_s']:g} s on"] if step else []
    gone, change, off = (resolved.get(group) for group in ("vanishing_dots", "friction_change", "calibration"))
    off_px = off.get("offset_px", [0.0, 0.0]) if off else []
    play, stiffness = faults["backlash_ticks"], resolved["gel"].get("stiffness_factor", 1.0)
    factor = gripper.get("friction_factor", [1.0, 1.0])
    factor = factor if isinstance(factor, list) else [factor, factor]
    rubs = f"x {factor[0]:g}" + (f" to {factor[1]:g}" if factor[1] > factor[0] else "")
    mass = f"{resolved['object']['mass_g']:g} g" if "object" in resolved else ""
    noise, delay_ms, jitter_ms = (faults[key] for key in GRIPPER_FAULTS[1:])
    late = (
        f"by {delay_ms:.3g} to {delay_ms + jitter_ms:.3g} ms"
        if jitter_ms
        else f"by {delay_ms:.3g} ms"
        if delay_ms
        else ""
    )
    profile = {"s-curve": "an s-curve", "steps": "steps at 125 Hz"}.get(hand.get("profile", ""), "")
    named = {
        ("changing light", "light"): (", ".join(lights), "steady: none named"),
        ("vanishing dots", "vanishing_dots"): (
            f"{len(gone['dots'])} from {gone['at_s']:g} s on" if gone else "",
            "none named",
        ),
        ("calibration that is off", "calibration"): (
            f"by {off_px[0]:g}, {off_px[1]:g} px and {off.get('turned_deg', 0.0):g} deg" if off else "",
            "the dots at rest are known",
        ),
        ("change of friction", "friction_change"): (
            f"x {change['factor']:g} from {change['at_s']:g} s on" if change else "",
            "none named",
        ),
        ("gear friction", "gripper.friction_factor"): (
            rubs if factor != [1.0, 1.0] else "",
            "as the sensor's gripper has it",
        ),
        ("backlash of the gripper", "gripper.backlash_ticks"): (f"{play:.3g} ticks" if play else "", "none named"),
        ("second finger of its own", "gripper.second_finger"): (_second(gripper), "a mirror image of the first"),
        ("noise of the gripper's encoder", "gripper.encoder_noise_ticks"): (
            f"{noise:.3g} ticks" if noise else "",
            "it reads the motor's place",
        ),
        ("commands that come late", "gripper.command_delay_ms"): (late, "in effect in the next ms"),
        ("profile of the hand's motion", "hand.profile"): (profile, "a trapezoid of speed"),
        ("vibration of the hand", "hand.vibration"): (_vibration(hand), "none named"),
        ("jerk of the hand", "hand.jerk"): (
            f"{jerk['speed_mm_s']:g} mm/s for {jerk['lasts_s']:g} s at {jerk['at_s']:g} s" if jerk else "",
            "none named",
        ),
        ("other stiffness of the gel", "gel.stiffness_factor"): (
            f"x {stiffness:g}" if stiffness != 1.0 else "",
            "as the sensor has it",
        ),
        ("other mass of the object", "object"): (mass, "none named"),
    }
    measured = (  # the others cost nothing
        "changing light",
        "vanishing dots",
        "change of friction",
        "second finger of its own",
        "profile of the hand's motion",
        "vibration of the hand",
        "jerk of the hand",
    )
    return [
        Part(name, built, why_not, _without(*place.split(".")) if built and name in measured else None)
        for (name, place), (built, why_not) in named.items()
    ]


def _without(*place: str) -> Callable[[Plan], None]:
    def leave_out(plan: Plan) -> None:
        named = plan["scene"]
        for key in place[:-1]:
            named = named[key]
        del named[place[-1]]

    return leave_out


def _without_noise(plan: Plan) -> None:
    plan["sensor_row"] |= {"noise_hz": 0.0, "hot_pixels": 0}
    plan["sensor_row"].pop("hot_pixel_table", None)


def _without_sensor(*keys: str) -> Callable[[Plan], None]:
    def leave_out(plan: Plan) -> None:
        plan["sensor_row"] |= {key: type(plan["sensor_row"][key])(0) for key in keys}

    return leave_out


def _unnamed_in_sensor(key: str) -> Callable[[Plan], None]:
    def leave_out(plan: Plan) -> None:
        del plan["sensor_row"][key]

    return leave_out


def _show_texture(plan: Plan) -> None:
    plan["scene"]["gel"]["cut"] = True
    plan["scene"]["texture"]["show"] = True


def _second(gripper: Plan) -> str:
    """What a second finger has otherwise than the first."""
    named = gripper.get("second_finger", {})
    return ", ".join(f"{key.removesuffix('_factor')} x {named[key]:g}" for key in named)


def _vibration(hand: Plan) -> str:
    """The sine waves of a hand's vibration."""
    named = hand.get("vibration")
    if named is None:
        return ""
    waves = zip(named["acceleration_m_s2"], named["frequency_hz"], strict=True)
    listed = ", ".join(f"{acceleration:g} m/s2 at {frequency:g} Hz" for acceleration, frequency in waves)
    return f"{listed}, while it rises" if named.get("only_moving", False) else listed


def _creep(sensor_row: Plan) -> str:
    """By how much of its stiffness a sensor's gel yields, and how slowly."""
    named = sensor_row.get("creep", {})
    arms = zip(named.get("share", []), named.get("time_s", []), strict=False)
    return ", ".join(f"{share:.0%} in {time_s:.3g} s" for share, time_s in arms)


def _without_creep(plan: Plan) -> None:
    del plan["sensor_row"]["creep"]


def _even_friction(plan: Plan) -> None:
    named = plan["sensor_row"]["friction"]
    plan["sensor_row"]["friction"] = {key: named[key] for key in named if not key.startswith("patch_")}


def _hide_texture(plan: Plan) -> None:
    plan["scene"]["texture"]["show"] = False


def _no_edges(plan: Plan) -> None:
    plan["scene"]["rub"]["edge_log_contrast"] = [0.0, 0.0]
