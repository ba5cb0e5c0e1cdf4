"""Open the named camera and gripper, and the virtual devices behind them.

All code that moves a gripper passes through here, or through `require_arm`, which is the only check for --arm.
"""

from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from evetac_cli.devices import Rig
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.devices.plugin_devices import open_camera, open_gripper
from evetac_cli.errors import InputError
from evetac_cli.names import Capability
from evetac_cli.sim.setup.plan import Plan

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.gripper import VirtualGripper
    from evetac_cli.devices.virtual.world import VirtualWorld


def require_arm(gripper: NamedGripper, *, armed: bool, plan: str = "", hint: str = "") -> None:
    """Raise InputError if real fingers would move without --arm; plan: a sentence that describes the planned motion."""
    if gripper.has(Capability.HARDWARE) and not armed:
        raise InputError(
            "this would move a real gripper",
            where=str(gripper),
            expected="--arm, after checking that nothing unintended is between the fingers",
            found=plan,
            hint=hint or "--dry-run shows the whole plan",
        )


def open_peers(
    camera: NamedCamera,
    gripper: NamedGripper,
    plan: Plan | None,
    seeds: np.random.SeedSequence,
    opened: ExitStack,
    *,
    armed: bool,
    sends_truth: bool,
    **durations: float,
) -> tuple["VirtualWorld | None", "VirtualGripper | None"]:
    """Start the virtual world and servo that the names require, None for real devices; they are closed with `opened`.

    plan: the setup that the world simulates, as in devices.simulated.rig; armed: whether a real gripper may be moved;
    sends_truth: whether the world sends its ground truth. The world's time waits for a busy machine, unless a real
    gripper moves.
    """
    require_arm(gripper, armed=armed)
    world = None
    if plan is not None and camera.has(Capability.SCENE):
        from evetac_cli.devices.virtual.world import VirtualWorld

        waits = not gripper.has(Capability.HARDWARE)
        world = VirtualWorld(plan, seeds, sends_truth=sends_truth, waits=waits, **durations)
        opened.callback(world.close)
    servo = gripper.open_peer(world.plant if world is not None else None)
    if servo is not None:
        opened.callback(servo.close)
    return world, servo


def open_rig(
    camera: NamedCamera,
    gripper: NamedGripper,
    settings: CameraSettings,
    plan: Plan | None,
    seeds: np.random.SeedSequence,
    *,
    armed: bool = False,
    mode: Mode = "current",
) -> Rig:
    """Open the named devices, the gripper first, because a camera's clock starts when it is opened.

    plan: the setup of a simulated scene; armed: whether a real gripper may be moved; mode: of the gripper. InputError
    if the gripper may not be moved; DeviceError if a device cannot be opened. Devices opened before the error are
    closed again.
    """
    if camera.has(Capability.STEPPED):
        from evetac_cli.devices.simulated import rig

        assert plan is not None
        return rig(plan, seeds)
    with ExitStack() as opened:
        world, servo = open_peers(camera, gripper, plan, seeds, opened, armed=armed, sends_truth=False)
        driver, gripper_setup = open_gripper(gripper, mode, gripper.port if servo is None else servo.port)
        if driver is not None:
            opened.callback(driver.close)
        running, camera_setup, parents = open_camera(camera, settings, world, seeds)
        opened.pop_all()
    return Rig(
        running,
        driver,
        holding_ma=world.holding_ma if world else 0.0,
        sampled=world.sampled if world else "",
        fall_factor=world.fall_factor if world else 1.0,
        sensor=world.sensor if world else {},
        setup={"camera": camera_setup, "gripper": gripper_setup},
        simulated=camera.has(Capability.SIMULATED),
        parents=parents,
        peers=tuple(peer for peer in (servo, world) if peer is not None),
    )
