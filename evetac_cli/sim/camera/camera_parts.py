"""The parts of a scene that its camera sees or is made of; `gel_camera` builds them from a sensor and a scene."""

from dataclasses import replace

from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene import Texture
from evetac_cli.sim.setup.scene_part import Essential, ScenePart


class Camera(Essential):
    """Pixels that fire where the brightness has changed by a threshold."""

    NAME = "camera"
    KEYS = ("sensor.threshold", "sensor.mismatch", "sensor.edge_sigma_px", "sensor.log_contrast")


class Dots(Essential):
    """Dots printed on the gel."""

    NAME = "dots"
    KEYS = ("sensor.dot_columns_px", "sensor.dot_rows_px", "sensor.dot_xy_px", "sensor.dot_radius_px")


class DifferingDots(ScenePart):
    """Dots of unequal radius and contrast."""

    NAME = "dots that differ"
    KEYS = ("sensor.dot_radius_spread", "sensor.dot_contrast_spread")


class Window(ScenePart):
    """The object's texture, seen through the window of a cut gel."""

    NAME = "window"
    KEYS = ("sensor.window_px", "scene.gel.cut", "scene.texture")

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan shows a texture; only an object in a gripper has one."""
        return plan.scene.is_gripped and plan.scene.shows_texture

    @classmethod
    def without(cls, plan: Plan) -> Plan:
        """Return the plan with the texture out of view; all other events stay the same."""
        return _with_texture(plan, show=False)

    @classmethod
    def switched(cls, plan: Plan) -> Plan | None:
        """Return the plan without the texture, or with it where the scene has one that is not shown."""
        if plan.scene.texture is None or cls.is_in(plan):
            return super().switched(plan)
        scene = replace(plan.scene, gel=replace(plan.scene.gel, cut=True))
        return _with_texture(replace(plan, scene=scene), show=True)


def _with_texture(plan: Plan, *, show: bool) -> Plan:
    texture = replace(plan.scene.texture or Texture(), show=show)
    return replace(plan, scene=replace(plan.scene, texture=texture))


class VisibleEdges(ScenePart):
    """The visible edges of an object that a hand rubs over the gel; without contrast they are invisible."""

    NAME = "contact edges"
    KEYS = ("scene.rub.edge_log_contrast", "scene.rub.edge_blur_px")

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan has an object whose edges are visible."""
        return plan.scene.rub is not None and plan.scene.rub.edge_log_contrast[1] > 0.0

    @classmethod
    def without(cls, plan: Plan) -> Plan:
        """Return the plan with invisible edges."""
        assert plan.scene.rub is not None
        return replace(plan, scene=replace(plan.scene, rub=replace(plan.scene.rub, edge_log_contrast=(0.0, 0.0))))


class CutEdge(ScenePart):
    """The dark edge of a cut gel next to the window."""

    NAME = "cut edge"
    KEYS = ("sensor.cut_contrast", "sensor.cut_width_px", "sensor.cut_jitter_px")

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan's gel is cut and the edge is dark."""
        return plan.scene.gel.cut and plan.sensor.cut_contrast > 0.0


class NoiseEvents(ScenePart):
    """Noise events of pixels that are not hot."""

    NAME = "noise"
    KEYS = ("sensor.noise_hz", "sensor.noise_on_share", "sensor.timestamp_step_us")

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan's pixels are noisy."""
        return plan.sensor.noise_hz > 0.0

    @classmethod
    def without(cls, plan: Plan) -> Plan:
        """Return the plan with pixels without noise."""
        return replace(plan, sensor=replace(plan.sensor, noise_hz=0.0))


class HotPixelEvents(ScenePart):
    """Pixels that fire without cause, at random or known positions."""

    NAME = "hot pixels"
    KEYS = (
        "sensor.hot_pixels",
        "sensor.hot_pixel_hz",
        "sensor.hot_pixel_table",
        "sensor.hot_pixel_table.rate_hz",
    )

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether any of a plan's pixels is hot."""
        table = plan.sensor.hot_pixel_table
        return plan.sensor.hot_pixels > 0 or (table is not None and len(table.x_px) > 0)


class HostFilter(ScenePart):
    """The noise filter that the host applies to the camera's events."""

    NAME = "noise filter"
    KEYS = ("sensor.noise_filter.support_ms",)


class OffThreshold(ScenePart):
    """A threshold of OFF events that differs from that of ON events."""

    NAME = "OFF threshold of its own"
    KEYS = ("sensor.threshold_off",)


class SlowReadout(ScenePart):
    """A readout that delays events under load."""

    NAME = "limit of the readout"
    KEYS = ("sensor.readout.events_per_s",)


class SlowPixels(ScenePart):
    """Pixels that follow a change with a delay."""

    NAME = "slow pixels"
    KEYS = ("sensor.bandwidth_hz",)


class BandwidthByLight(ScenePart):
    """Slow pixels that are slower in the dark."""

    NAME = "bandwidth that falls with light"
    KEYS = ("sensor.bandwidth_by_light",)

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan's pixels are slow, and slower in the dark."""
        return SlowPixels.is_in(plan) and super().is_in(plan)


class UnevenLight(ScenePart):
    """Less light at the corners of the frame; only pixels that are slower in the dark show it."""

    NAME = "uneven light"
    KEYS = ("sensor.light_gradient",)

    @classmethod
    def is_in(cls, plan: Plan) -> bool:
        """Return whether a plan's light is uneven and its pixels show it."""
        return BandwidthByLight.is_in(plan) and super().is_in(plan)


class LensDistortion(ScenePart):
    """A lens that shows points nearer to the middle of the frame, or farther from it."""

    NAME = "lens distortion"
    KEYS = ("sensor.distortion",)


class Leak(ScenePart):
    """ON events that pixels leak at rest."""

    NAME = "leak"
    KEYS = ("sensor.leak_hz",)


class BlindPixels(ScenePart):
    """Pixels that are blind for a time after an event."""

    NAME = "blind pixels"
    KEYS = ("sensor.refractory_us",)


class ChangingLight(ScenePart):
    """Light that flickers or steps."""

    NAME = "changing light"
    KEYS = ("scene.light", "scene.light.flicker.depth", "scene.light.step.factor")


class DotsThatVanish(ScenePart):
    """Dots whose ink comes off."""

    NAME = "vanishing dots"
    KEYS = ("scene.vanishing_dots.dots", "scene.vanishing_dots.at_s")


class WrongCalibration(ScenePart):
    """A recording whose dots at rest are not where its calibration says."""

    NAME = "calibration that is off"
    KEYS = ("scene.calibration.offset_px", "scene.calibration.turned_deg")
    MEASURED = False
