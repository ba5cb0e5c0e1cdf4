"""The camera individual behind a gel: its dots at rest, its window or none, what texture it sees there."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.sim import camera, ideal
from evetac_cli.sim.camera import CameraState
from evetac_cli.sim.ideal import IdealState

Floats = NDArray[np.float64]


def dot_grid(individual: Mapping[str, Any], cut: bool) -> Floats:
    """Dot centres at rest (rows, columns, 2) in px: the individual's grid, turned, with its jitter.

    A cut gel lacks the columns that the window took away.
    """
    columns, rows = individual["dot_columns_px"], individual["dot_rows_px"]
    rng = np.random.default_rng(individual["seed"])
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    grid = grid + rng.normal(0.0, individual["dot_jitter_px"], grid.shape)
    angle = np.deg2rad(individual["turned_deg"])
    middle = np.array(individual["frame_px"]) / 2
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    grid = (grid - middle) @ turn + middle
    kept = grid[..., 0].max(axis=0) + individual["dot_radius_px"] < individual["window_px"][0]
    dots: Floats = grid[:, kept] if cut else grid
    return dots


class Eye:
    """A camera that looks at dots, and through the window at an object."""

    def __init__(
        self,
        individual: Mapping[str, Any],
        *,
        cut: bool,
        texture: NDArray[np.float32] | None,
        rng: np.random.Generator,
        readout: str = "dvxplorer",
    ) -> None:
        self.grid_xy_px = dot_grid(individual, cut)
        x0, y0, x1, y1 = individual["window_px"]
        self.window_px: tuple[int, int, int, int] | None = (x0, y0, x1, y1) if cut else None
        self.mm_per_px = float(individual["mm_per_px"])
        frame = np.array(individual["frame_px"])
        self.rest_m = (self.grid_xy_px.reshape(-1, 2) - frame / 2) * self.mm_per_px * 1e-3
        model = camera.CameraModel(
            frame_px=tuple(individual["frame_px"]),
            threshold=individual["threshold"],
            mismatch=individual["mismatch"],
            noise_rate_hz=individual["noise_hz"],
            hot_pixels=individual["hot_pixels"],
            hot_rate_hz=tuple(individual["hot_pixel_hz"]),
            edge_sigma_px=individual["edge_sigma_px"],
            log_contrast=individual["log_contrast"],
            dot_radius_px=individual["dot_radius_px"],
        )
        self._rng = rng
        self._texture_at_px = rng.uniform(0, texture.shape[0], 2) if texture is not None else np.zeros(2)
        self.dot_xy_px = self.grid_xy_px.reshape(-1, 2).copy()
        self.object_xy_px = np.zeros(2)
        window = self.window_px if texture is not None else None
        built = np.random.default_rng([individual["seed"], 1])
        if readout == "ideal":
            self._camera: CameraState | IdealState = ideal.start(
                model, self.dot_xy_px, None, window, texture, rng, built
            )
        else:
            self._camera = camera.start(model, self.dot_xy_px, None, window, texture, rng, built)

    def see(self, shift_m: Floats, object_m: Floats, contrast: float, t0_us: int) -> Events:
        """Events of a slice in which the dots come to be displaced by shift_m (dots, 2), and the object by object_m."""
        to_px = 1e3 / self.mm_per_px
        dots = self.grid_xy_px.reshape(-1, 2) + shift_m * to_px
        thing = object_m * to_px
        ends = (self.dot_xy_px, dots, self._texture_at_px + self.object_xy_px, self._texture_at_px + thing)
        if isinstance(self._camera, CameraState):
            events = camera.step(self._camera, *ends, contrast, t0_us, self._rng)
        else:
            events = ideal.step(self._camera, *ends, contrast, t0_us, self._rng)
        self.dot_xy_px, self.object_xy_px = dots, thing
        return events
