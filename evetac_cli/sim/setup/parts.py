"""The parts of a simulated scene, in the order in which users see them: one row each, with its keys.

A scene pays run time only for the parts that scene and sensor name. Code builds a part where it acts, if the settings
have it; the rows describe it for dry runs, docs and tests. A Timer measures the calls that represent a part.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Protocol, TypeVar

from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.tables import as_table

MOST_SHOWN = 4  # values of a list; longer ones are not shown

Settings = TypeVar("Settings")


def _always(plan: Plan) -> bool:
    return True


@dataclass(frozen=True)
class ScenePart:
    """A part of a scene.

    keys: those that name it, of a plan's sensor or scene, for example `scene.drop.mass_g`.

    exists: whether a plan has it; if None, a plan has it if one of the keys differs from its default. gripped: only
    where a gripper holds an object.

    measured: whether it costs run time and can be left out alone, so that a dry run measures its cost.

    off: values without the part, if they are others than the defaults of its keys. on: values with which the cost of
    the part is measured where a plan lacks it.
    """

    name: str
    keys: tuple[str, ...] = ()
    exists: Callable[[Plan], bool] | None = None
    gripped: bool = False
    measured: bool = True
    off: Mapping[str, Any] = field(default_factory=dict)
    on: Mapping[str, Any] = field(default_factory=dict)

    def is_in(self, plan: Plan) -> bool:
        """Return whether a plan has the part."""
        if self.gripped and not plan.scene.is_gripped:
            return False
        if self.exists is not None:
            return self.exists(plan)
        return any(_at(plan, key) != _default(plan, key) for key in self.keys)

    def describe(self, plan: Plan) -> str | None:
        """Return the values of the part's keys, without tables and long lists; None if the plan lacks the part."""
        if not self.is_in(plan):
            return None
        tables = {"sensor": as_table(plan.sensor), "scene": as_table(plan.scene)}
        return self._described(tables) or self._described({"sensor": asdict(plan.sensor), "scene": asdict(plan.scene)})

    def _described(self, tables: Mapping[str, Any]) -> str:
        found = []
        for key in self.keys:
            value: Any = tables
            for name in key.split("."):
                value = value.get(name) if isinstance(value, dict) else None
            if not (value is None or isinstance(value, dict) or (isinstance(value, list) and len(value) > MOST_SHOWN)):
                found.append(f"{name} {_shown(value)}")
        return ", ".join(found)

    def without(self, plan: Plan) -> Plan:
        """Return the same plan without the part."""
        if self.off:
            return _with(plan, self.off)
        for key in self.keys:
            plan = _reset(plan, key)
        return plan

    def switched(self, plan: Plan) -> Plan | None:
        """Return the plan with which the part's cost is measured; None if it is not measured."""
        if self.is_in(plan):
            return self.without(plan) if self.measured else None
        return _with(plan, self.on) if self.on and all(_at(plan, key) is not None for key in self.on) else None


def _at(one: Any, key: str) -> Any:
    """Return the value at a dotted key; None if a table on the way to it is left out."""
    for name in key.split("."):
        one = None if one is None else getattr(one, name)
    return one


def _default(one: Any, key: str) -> Any:
    """Return the default of a dotted key; None if a table on the way to it is left out by default."""
    name, _, inner = key.partition(".")
    default = next(item.default for item in fields(one) if item.name == name)
    value = getattr(one, name)
    if not inner or value is None or default is None:
        return default
    return _default(value, inner)


def _reset(one: Settings, key: str) -> Settings:
    """Return settings with the value at a dotted key, or the optional table that holds it, as by default."""
    name, _, inner = key.partition(".")
    item = next(item for item in fields(one) if item.name == name)  # type: ignore[arg-type]
    if inner and item.default is not None:
        return replace(one, **{name: _reset(getattr(one, name), inner)})  # type: ignore[type-var]
    return replace(one, **{name: item.default})  # type: ignore[type-var]


def _with(one: Settings, values: Mapping[str, Any]) -> Settings:
    """Return settings with values at dotted keys."""
    for key, value in values.items():
        name, _, inner = key.partition(".")
        one = replace(one, **{name: _with(getattr(one, name), {inner: value}) if inner else value})  # type: ignore[type-var]
    return one


def _shown(value: Any) -> str:
    if isinstance(value, list):
        if len(value) == 2 and value[0] == value[1]:
            return _shown(value[0])  # a range of one number
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


GEL = ScenePart(
    "gel and friction",
    (
        *("sensor.shear_modulus_pa", "sensor.normal_modulus_pa"),
        *("scene.randomise.static_friction", "scene.randomise.memory_um"),
        *("scene.solver.node_pitch_mm", "scene.solver.tolerance_um", "scene.solver.step_ms"),
    ),
    lambda plan: plan.scene.tone is None,  # a speaker sticks to the gel
    measured=False,
)
GRIPPER = ScenePart("gripper", ("sensor.gripper", "scene.kind", "scene.gripper"), _always, gripped=True, measured=False)
CAMERA = ScenePart(
    "camera",
    ("sensor.threshold", "sensor.mismatch", "sensor.edge_sigma_px", "sensor.log_contrast"),
    _always,
    measured=False,
)
SECOND_CAMERA = ScenePart("camera of the second finger", (), lambda plan: plan.second is not None, measured=False)
DOTS = ScenePart(
    "dots",
    ("sensor.dot_columns_px", "sensor.dot_rows_px", "sensor.dot_xy_px", "sensor.dot_radius_px"),
    _always,
    measured=False,
)


def _fault(name: str, *keys: str) -> ScenePart:
    """Return an imperfection of the gripper, by keys that a scene's gripper and a sensor's own have; 0 means none."""
    of_both = tuple(f"{owner}.gripper.{key}" for owner in ("sensor", "scene") for key in keys)
    return ScenePart(name, of_both, lambda plan: any(map(plan.of_gripper, keys)), gripped=True, measured=False)


def _pressure_matters(plan: Plan) -> bool:
    own = plan.sensor.friction.pressure_exponent  # comes before the scene's
    return (plan.scene.randomise.pressure_exponent[1] if own is None else own) > 0.0


PARTS = (
    GEL,
    ScenePart(
        "friction that varies over the gel",
        ("sensor.friction.patch_spread", "sensor.friction.patch_mm"),
        lambda plan: plan.scene.tone is None and bool(plan.sensor.friction.patch_spread),
    ),
    ScenePart(
        "friction over pressure",
        ("sensor.friction.pressure_exponent", "scene.randomise.pressure_exponent"),
        _pressure_matters,
        gripped=True,
        off={"sensor.friction.pressure_exponent": 0.0},
    ),
    ScenePart("roughness of the object", ("scene.roughness.friction_sd", "scene.roughness.length_mm"), gripped=True),
    ScenePart("slow creep", ("sensor.creep.share", "sensor.creep.time_s")),
    ScenePart(
        "what touches",
        ("scene.kind", "scene.face", "scene.rub", "scene.rub.objects", "scene.tone", "scene.tone.frequency_hz"),
        _always,
        measured=False,
    ),
    ScenePart("change of friction", ("scene.friction_change.at_s", "scene.friction_change.factor")),
    ScenePart("other stiffness of the gel", ("scene.gel.stiffness_factor",), measured=False),
    GRIPPER,
    ScenePart(
        "gear friction",
        ("sensor.gripper.friction_factor", "scene.gripper.friction_factor"),
        gripped=True,
        measured=False,
    ),
    ScenePart("gear that breaks loose", ("sensor.gripper.kinetic_share",), gripped=True, measured=False),
    _fault("backlash of the gripper", "backlash_ticks"),
    _fault("noise of the gripper's encoder", "encoder_noise_ticks"),
    _fault("commands that come late", "command_delay_ms", "command_jitter_ms"),
    ScenePart(
        "second finger of its own",
        ("scene.gripper.second_finger",),
        lambda plan: plan.fingers_differ,
        off={"scene.gripper.second_finger": None, "second": None},
    ),
    ScenePart("free object", ("scene.kind",), _always, gripped=True, measured=False),
    ScenePart("other mass of the object", ("scene.object.mass_g",), measured=False),
    ScenePart("pushes", ("scene.push", "scene.push.lasts_s")),
    ScenePart("falling weight", ("scene.drop", "scene.drop.mass_g")),
    ScenePart(
        "table and hand", ("scene.hand", "scene.hand.height_mm"), lambda plan: plan.scene.kind == "lift", measured=False
    ),
    ScenePart("profile of the hand's motion", ("scene.hand.profile",)),
    ScenePart("vibration of the hand", ("scene.hand.vibration", "scene.hand.vibration.frequency_hz")),
    ScenePart("jerk of the hand", ("scene.hand.jerk", "scene.hand.jerk.speed_mm_s")),
    SECOND_CAMERA,
    CAMERA,
    DOTS,
    ScenePart("dots that differ", ("sensor.dot_radius_spread", "sensor.dot_contrast_spread")),
    ScenePart(
        "window",
        ("sensor.window_px", "scene.gel.cut", "scene.texture"),
        lambda plan: plan.scene.shows_texture,
        gripped=True,
        off={"scene.texture.show": False},  # all other events stay the same
        on={"scene.texture.show": True, "scene.gel.cut": True},
    ),
    ScenePart(
        "contact edges",
        ("scene.rub.edge_log_contrast", "scene.rub.edge_blur_px"),
        lambda plan: plan.scene.rub is not None and plan.scene.rub.edge_log_contrast[1] > 0.0,
        off={"scene.rub.edge_log_contrast": (0.0, 0.0)},
    ),
    ScenePart(
        "cut edge",
        ("sensor.cut_contrast", "sensor.cut_width_px", "sensor.cut_jitter_px"),
        lambda plan: plan.sensor.has_dark_cut(cut=plan.scene.gel.cut),
    ),
    ScenePart(
        "noise",
        ("sensor.noise_hz", "sensor.noise_on_share", "sensor.timestamp_step_us"),
        lambda plan: plan.sensor.noise_hz > 0.0,
        off={"sensor.noise_hz": 0.0},
    ),
    ScenePart(
        "hot pixels",
        ("sensor.hot_pixels", "sensor.hot_pixel_hz", "sensor.hot_pixel_table", "sensor.hot_pixel_table.rate_hz"),
        lambda plan: plan.sensor.hot_pixels > 0 or bool((table := plan.sensor.hot_pixel_table) and table.x_px),
    ),
    ScenePart("noise filter", ("sensor.noise_filter.support_ms",)),
    ScenePart("OFF threshold of its own", ("sensor.threshold_off",)),
    ScenePart("limit of the readout", ("sensor.readout.events_per_s",)),
    ScenePart("slow pixels", ("sensor.bandwidth_hz",)),
    ScenePart(
        "bandwidth that falls with light", ("sensor.bandwidth_by_light",), lambda plan: plan.sensor.is_slow_in_dark
    ),
    ScenePart(
        "uneven light",
        ("sensor.light_gradient",),
        lambda plan: plan.sensor.is_slow_in_dark and plan.sensor.light_gradient > 0.0,  # else no pixel shows it
    ),
    ScenePart("lens distortion", ("sensor.distortion",)),
    ScenePart("leak", ("sensor.leak_hz",)),
    ScenePart("blind pixels", ("sensor.refractory_us",)),
    ScenePart("changing light", ("scene.light", "scene.light.flicker.depth", "scene.light.step.factor")),
    ScenePart("vanishing dots", ("scene.vanishing_dots.dots", "scene.vanishing_dots.at_s")),
    ScenePart(
        "calibration that is off", ("scene.calibration.offset_px", "scene.calibration.turned_deg"), measured=False
    ),
)


def rows_of(plan: Plan) -> list[dict[str, Any]]:
    """Return a row per part: the values that describe it if the plan has it, None if it is left out."""
    return [{"part": part.name, "built": part.describe(plan)} for part in PARTS]


def switched(plan: Plan) -> dict[str, Plan]:
    """Return, by part, the plan with which the cost of that part is measured: the same plan with the part switched."""
    plans = {part.name: part.switched(plan) for part in PARTS}
    return {name: other for name, other in plans.items() if other is not None}


Call = TypeVar("Call", bound=Callable[..., Any])


class Timer(Protocol):
    """Measures the calls that belong to a part; code that makes such calls wraps them once and keeps the result."""

    def __call__(self, part: str, call: Call) -> Call:
        """Return the call, wrapped so that its time is counted for the part."""


def untimed(part: str, call: Call) -> Call:
    """Return the call itself: nothing is measured, so it costs nothing."""
    return call
