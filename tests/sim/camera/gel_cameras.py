"""The camera of a sensor behind a gel that nothing touches, in a scene that names nothing else."""

import numpy as np

from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.setup.scene import GelSettings, Scene, SceneTimes
from evetac_cli.sim.setup.sensor import Sensor


def gel_camera(sensor: Sensor, *, cut: bool, seed: int = 0) -> GelCamera:
    """Switch the camera of a sensor on, behind a cut or a closed gel."""
    scene = Scene(name="plain", kind="press", summary="", time=SceneTimes(), gel=GelSettings(cut=cut))
    return GelCamera(sensor, scene=scene, texture=None, rng=np.random.default_rng(seed))
