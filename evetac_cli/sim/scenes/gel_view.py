"""What a camera sees of a gel: the dots and the cut edge move with the shear of the pad and nearer to the lens."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US, Events
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.gel import dots, gel
from evetac_cli.sim.gel.cell_gaps import CellGaps
from evetac_cli.sim.scenes.shared import STEP_S
from evetac_cli.sim.scenes.true_slip import RECENT_MS, GroundTruthSlip
from evetac_cli.sim.setup.parts import CAMERA, SECOND_CAMERA, Timer

# From coordinates of the pad, which are those of the first sensor, to those of the first sensor's image and of the
# second's, which faces it; and back.
ALONG, FACING = np.ones(2), np.array([1.0, -1.0])
OUT_OF_SIGHT_M = np.zeros(2)  # position of an object without visible texture


class DotPath:
    """Path of the gel under the dots within a slice, for a camera that uses more than one straight line per slice."""

    def __init__(self, pad_state: gel.GelState, at_dots: tuple[NDArray[np.intp], Floats], pieces: int) -> None:
        self._gel = pad_state
        self._at_dots = at_dots
        self._times = np.linspace(0.0, STEP_S, pieces + 1)
        self._reached_s: list[float] = []
        self._shift_m: list[Floats] = []

    def begin(self) -> None:
        """Start a slice at the gel's present state."""
        self._reached_s, self._shift_m = [0.0], [dots.displacement_at(self._gel, *self._at_dots)]

    def follow(self, _: gel.StepInfo, dt_s: float) -> None:
        """Store the gel's state after a step."""
        self._reached_s.append(self._reached_s[-1] + dt_s)
        self._shift_m.append(dots.displacement_at(self._gel, *self._at_dots))

    def pieces(self, before_m: Floats, after_m: Floats) -> Floats:
        """Return the displacement at the ends of all pieces, (pieces + 1, dots, 2), with shifts other than shear."""
        place = np.interp(self._times, self._reached_s, np.arange(len(self._reached_s)))
        low = np.minimum(place.astype(np.intp), len(self._reached_s) - 2)
        part = (place - low)[:, None, None]
        shift_m = np.stack(self._shift_m)
        along = (self._times / STEP_S)[:, None, None]
        path: Floats = shift_m[low] * (1 - part) + shift_m[low + 1] * part + before_m * (1 - along) + after_m * along
        path[-1] = shift_m[-1] + after_m  # exact, also if steps of 0.1 ms add up to more than the slice
        return path


class GelView:
    """A camera's view of a pad, slice by slice, and the true slip of what it sees."""

    def __init__(
        self, camera: GelCamera, pad: gel.GelState, pieces: int, timer: Timer, *, second: bool = False
    ) -> None:
        """Start the view; pieces: number of straight pieces of a dot's path in each slice; second: of that finger."""
        self.camera = camera
        self.render = timer((SECOND_CAMERA if second else CAMERA).name, camera.render)
        self._pad = pad
        facing = self._facing = FACING if second else ALONG
        rest_m, cut_m = camera.rest_m * facing, camera.cut_rest_m * facing
        self._at_dots = dots.interpolation(pad.node_xy_m, rest_m)
        self._at_seen = dots.interpolation(pad.node_xy_m, np.concatenate([rest_m, cut_m]))
        self._path = DotPath(pad, self._at_dots, pieces) if pieces > 1 else None
        self.slip = GroundTruthSlip(pad, camera.mm_per_px, camera.window_px)
        self._indented_m = -1.0  # the indentation for which _nearer_m was computed
        self._before_m = self._nearer_m = np.zeros_like(camera.rest_m)
        self._seen_m = np.zeros_like(camera.rest_m), np.zeros_like(camera.cut_rest_m)
        self._object: tuple[Floats, float] = (OUT_OF_SIGHT_M, 0.0)

    def begin(self) -> Callable[[gel.StepInfo, float], None] | None:
        """Start a slice; return what each of its steps must call, if anything."""
        if self._path is None:
            return None
        self._path.begin()
        return self._path.follow

    def follow(self, shares: Floats, force_n: float, still_for: int) -> None:
        """Follow the slip of a slice; without motion for longer than RECENT_MS it does not change."""
        if still_for <= RECENT_MS:
            self.slip.follow(self._pad, shares, force_n)

    def indent(self, indentation_m: float, gaps: CellGaps) -> None:
        """Move the dots nearer to the lens if the indentation has changed."""
        if indentation_m != self._indented_m:
            self._indented_m = indentation_m
            self.press(gaps.depth_m(indentation_m))

    def press(self, depth_m: Floats) -> None:
        """Move the dots nearer to the lens, by the mean depth of each node's cell, (rows, columns)."""
        at_dots_m = dots.field_at(depth_m[..., None], *self._at_dots)[:, 0]
        self._nearer_m = dots.nearer_by(self.camera.rest_m, at_dots_m)

    def show(self, object_m: Floats, contrast: float) -> None:
        """Place the object's texture in the window."""
        self._object = object_m, contrast

    def see(self, slices: int, *, still: bool, strength: float = 0.0) -> Events:
        """Return the events of slice number `slices`; `still`: nothing has changed since the one before."""
        if not still:
            seen_m = dots.displacement_at(self._pad, *self._at_seen) * self._facing
            count = len(self.camera.rest_m)
            self._seen_m = seen_m[:count] + self._nearer_m, seen_m[count:]
        path_m = None
        if self._path is not None:
            ends_m = self._before_m * self._facing, self._nearer_m * self._facing
            path_m = self._path.pieces(*ends_m) * self._facing
        self._before_m = self._nearer_m
        shift_m, cut_m = self._seen_m
        return self.render(
            shift_m, *self._object, slices * SLICE_US, path_m, cut_m=cut_m, strength=strength, still=still
        )

    def truth(self) -> dict[str, Any]:
        """Return the ground truth of the view, by schema path."""
        return {"truth/dot_xy_px": self.camera.dot_xy_px.astype(np.float32), **self.slip.truth()}
