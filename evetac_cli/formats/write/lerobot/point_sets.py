"""Touch as a set of points: six numbers per dot, [dx dy dz Fx Fy Fz], and the wrench of the whole contact.

The layout is the one discussed in LeRobot's roadmap for 0.7 (huggingface/lerobot issue 3832, pull request 4469). It has
LeRobot's names: `displacement` has dx, dy, dz; `full` has the force too. The dot's displacement is (dx, dy). A camera
behind the gel does not measure dz: it is 0 and named `dz_unknown`. A dot's force is the sum over those cells of the
touch map that are nearest to this dot at rest, so the forces of all dots add up to the force of the map. Without touch
maps the forces of dots are unknown, and the layout is `displacement`.

The wrench [Fx Fy Fz Tx Ty Tz] is that of the object on the gel about the centre of pressure. Tx and Ty are 0: pressure
has no torque about its centre by definition, and shear, which acts in the gel's surface, has none about x and y. Fz is
positive when the gel is pressed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats, Singles
from evetac_cli.formats.write.lerobot.features import Feature, vector
from evetac_cli.formats.write.slice_columns import Masked, TrialFiles

POINTS, WRENCH = "observation.tactile.points", "observation.tactile.wrench"
MOVED = ("dx_px", "dy_px", "dz_unknown")
FORCE = ("fx_n", "fy_n", "fz_n")
TORQUE = ("tx_n_mm", "ty_n_mm", "tz_n_mm")
OF_WRENCH = ("touch_shear_x_n", "touch_shear_y_n", "touch_normal_n", "touch_torsion_n_mm")
M2_PER_MM2 = 1e-6
ONE_CELL_MM = 1.0  # side of a cell in a map that has only one row or column


class PointSet(NamedTuple):
    """The points of a data set: the number of dots, and whether their forces and the wrench are known."""

    dots: int
    has_forces: bool
    has_wrench: bool

    @property
    def layout(self) -> str:
        """The name of the layout."""
        return "full" if self.has_forces else "displacement"

    @property
    def names(self) -> tuple[str, ...]:
        """The names of a point's values."""
        return (*MOVED, *FORCE) if self.has_forces else MOVED

    def features(self, rule: str) -> dict[str, Feature]:
        """Return the features of the points and, if it is known, of the wrench.

        rule: a text on how a frame is computed from slices.
        """
        force = (
            "force from the touch map's cells nearest to the dot (estimated)"
            if self.has_forces
            else "without touch maps the force of a dot is unknown"
        )
        what = (
            f"layout `{self.layout}`: {', '.join(self.names)} of each dot, {rule}; displacement as tracked; dz is not"
            f" measured and is 0; {force}"
        )
        info = {"tactile.layout": self.layout, "tactile.dz": "not measured, 0"}
        features = {POINTS: Feature("float32", (self.dots, len(self.names)), self.names, what, info)}
        if self.has_wrench:
            about = "force and torque of the contact about its centre of pressure (estimated); tx and ty are 0"
            wrench = vector((*FORCE, *TORQUE), f"layout `wrench`: {about}, {rule}")
            features[WRENCH] = wrench._replace(info={"tactile.layout": "wrench"})
        return features

    def rows(self, columns: Sequence[str], frames: Singles, forces: Singles | None) -> dict[str, Singles]:
        """Return the points (frames, dots, 3 or 6) and the wrench (frames, 6).

        columns: names of the columns of `frames` (frames, n), displacements ordered by dot. forces: (frames, 3 * dots).
        """
        at = [number for number, name in enumerate(columns) if name not in OF_WRENCH]
        points = np.zeros((len(frames), self.dots, len(self.names)), np.float32)
        points[:, :, :2] = frames[:, at].reshape(len(frames), self.dots, 2)
        if forces is not None:
            points[:, :, 3:] = forces.reshape(len(frames), self.dots, 3)
        output = {POINTS: points}
        if self.has_wrench:
            output[WRENCH] = np.zeros((len(frames), 6), np.float32)
            output[WRENCH][:, [0, 1, 2, 5]] = frames[:, [columns.index(name) for name in OF_WRENCH]]
        return output


def tells_forces(files: TrialFiles) -> bool:
    """Whether the trial has touch maps, and the scale that relates them to the dots."""
    touch = files.by_kind.get("touch")
    return touch is not None and touch.has("map/slice") and files.mm_per_px is not None and _rest_px(files) is not None


def dot_forces(files: TrialFiles, slices: int) -> Masked:
    """Return each dot's force in N from the last map before each slice's end, (slices, 3 * dots); unknown is masked."""
    touch, rest_px = files.by_kind["touch"], _rest_px(files)
    assert rest_px is not None and files.mm_per_px is not None
    rest_mm = (rest_px - np.array(files.recording.frame_px) / 2) * files.mm_per_px()
    x_mm, y_mm = touch.read("map/x_mm"), touch.read("map/y_mm")
    to_dots = _nearest(rest_mm, x_mm, y_mm) * (_side_mm(x_mm) * _side_mm(y_mm) * M2_PER_MM2)
    shear, pressure = touch.read("map/shear_pa"), touch.read("map/pressure_pa")
    traction = np.concatenate([shear, pressure[:, None]], axis=1).reshape(len(shear), 3, -1)
    forces = (traction @ to_dots).transpose(0, 2, 1).reshape(len(shear), -1)  # (maps, 3 * dots)
    at = np.searchsorted(touch.read("map/slice"), np.arange(slices), side="right") - 1
    slice_forces = np.full((slices, forces.shape[1]), np.nan, np.float32)
    slice_forces[at >= 0] = forces[at[at >= 0]]
    return np.ma.masked_invalid(slice_forces)


def _rest_px(files: TrialFiles) -> Floats | None:
    """Return the dots at rest, (dots, 2), in the order of the displacements."""
    kinds = [files.by_kind[kind] for kind in ("tracks", "features", "recording") if kind in files.by_kind]
    grids = [file.read("sensor/dot_xy_px") for file in kinds if file.has("sensor/dot_xy_px")]
    return np.asarray(grids[0], np.float64).reshape(-1, 2) if grids else None


def _nearest(rest_mm: Floats, x_mm: Floats, y_mm: Floats) -> Floats:
    """Return which dot is nearest to each cell, as 0 and 1: (rows * columns of cells, dots); never a missing dot."""
    cells = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    far = np.linalg.norm(cells[:, None] - rest_mm, axis=2)
    return np.asarray(np.eye(len(rest_mm))[np.argmin(np.where(np.isfinite(far), far, np.inf), axis=1)])


def _side_mm(middles_mm: Floats) -> float:
    return float(middles_mm[1] - middles_mm[0]) if len(middles_mm) > 1 else ONE_CELL_MM
