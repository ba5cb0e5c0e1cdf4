"""Whether the object truly slips: gross slip over the contact that the camera sees, and the pad's last stuck node.

- Gross slip. What counts is how the object's surface moves against the gel, node by node; where the gel is sheared
  along with the object nothing slips. Over the visible contact, weighted by pressure, a translation and a rotation are
  fitted to this relative motion. The object slides as one body in a slice where they explain ONE_BODY of its mean
  square, or where ONE_BODY of the pressure rests on nodes that slip. It also does where as much rests on nodes that
  slid within the last RECENT_MS slices, if a translation and a rotation explain MOSTLY of the motion of these slices
  together. The fitted motions are summed over such slices, and slip is gross beyond SLIP_PX. It is over when for more
  than EPISODE_MS slices the object did not slide as one body.
- Last stuck node. The same distance, but of the mean motion over the whole pad, counted from when no loaded node
  sticks, seen or not. Beyond SLIP_PX it is what the first edition called slip.
- Incipient slip: the share of the normal force on slipping nodes, of the visible and of the whole contact.

Visible is a node that at rest lies in the frame, and not where a window was cut.

Why so: the mean of the relative motion alone would call incipient slip gross, whose edges slide for many pixels while
the rest sticks. The last stuck node alone is one that bears next to nothing, or that lies outside the frame. Of a
translation past a part f of the pressure that sticks, the fit explains 1 - f, so that a twentieth may be left. A
rotation about the contact's middle leaves nodes there stuck for long, because they hardly have to move: a stuck disc of
0.45 of the contact's radius takes away 4 %, and the object slips. The fit alone would be late: where all lets go the
gel relaxes unevenly, and for some slices the motion is that of no rigid body (object 6 of seed 3). What sticks at one
moment alone would miss slides: under a heavy object (20 of seed 10100) that slid at 40 mm/s nodes stuck and let go in
turn every 3 to 6 ms, so that hardly ever all of them slipped at once. That each node moved a little in that time would
be too little: where nodes are too far apart for unstable slip, all of them go on now and then while most stick. Under
2 kg whose weight is handed over (`evaluate stability sim`) this moves the object by 4 px in 100 ms, and it comes to
rest: translation and rotation explain at most 0.45 of the motion within RECENT_MS, which is one of the contact's edges.
Of object 20, seed 3, which went on to slide, they explain 0.58 by the time that it has slid by half a pixel.

The distance is the root mean square over the visible contact: where nothing turns it is that of the translation, and
where the object turns on the spot it does not vanish, as the mean would. The largest would hang on a node at the rim
that bears next to nothing.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.gel import GelState

SLIP_PX = 0.5  # an object that slid further than this as one body slips: the onset
ONE_BODY = 0.95  # share of the squared relative motion, or of the pressure, in an object that slides as one body
RECENT_MS = 10  # slices within which nodes stick and let go in turn, as long as an object slides
MOSTLY = 0.5  # share of the squared relative motion within that time, in an object that slides
EPISODE_MS = 3  # gross slip is over after so many slices in which the object does not slide as one body
SLOWEST_M = 1e-9  # in a slice, 1 um/s: anything slower is at rest
CONTACT_N = 0.01

# What vibrating scenes, in which everything sticks, say of every slice.
NO_SLIP = {
    "truth/slid_px": 0.0,
    "truth/slip": False,
    "truth/every_node_slid_px": 0.0,
    "truth/slip_share": 0.0,
    "truth/visible_slip_share": 0.0,
}


class GroundTruthSlip:
    """Follows object and gel slice by slice; `truth` says what slips at the end of the last one."""

    def __init__(self, state: GelState, mm_per_px: float, window_px: tuple[int, int, int, int] | None) -> None:
        """Start with a gel and an object that have not moved yet; window_px is None on a closed gel."""
        self._px_per_m = 1e3 / mm_per_px
        self.visible = visible_nodes(state.node_xy_m, mm_per_px, window_px)
        self._displacement_m = state.displacement_m.copy()
        self._slid_m = np.zeros((RECENT_MS, *state.displacement_m.shape))  # object against gel, in each recent slice
        self._seen_shares = np.zeros(state.stuck.shape)  # scratch
        self._rested_for = np.full(state.stuck.shape, RECENT_MS)  # slices since each node slid
        self._slices = 0
        self._pose = state.pose.copy()
        self._as_one_body = _Slide()
        self._every_node = _Slide()
        self._radius_m = 0.0
        self._slips = False
        self._share = self._visible_share = 0.0

    def follow(self, state: GelState, shares: Floats, force_n: float) -> None:
        """Take in one slice; shares: of each node in the normal force, (rows, columns); force_n: that force."""
        slid_m = self._slid_m[self._slices % RECENT_MS]
        self._slices += 1
        whole, recent_share, seen = _relative_motion(
            state.node_xy_m,
            state.displacement_m,
            self._displacement_m,
            slid_m,
            self._rested_for,
            state.pose,
            self._pose,
            shares,
            self.visible,
            state.stuck,
            self._seen_shares,
        )
        self._pose[:] = state.pose
        touches = force_n > CONTACT_N
        self._share, self._visible_share, stuck, x_m, y_m = whole if touches else (0.0, 0.0, 0.0, 0.0, 0.0)
        self._every_node.follow(touches and stuck == 0.0 and math.hypot(x_m, y_m) > SLOWEST_M, x_m, y_m, 0.0)
        rigid_share, radius_m, x_m, y_m, turn_rad = seen if touches else (0.0, 0.0, 0.0, 0.0, 0.0)
        if radius_m > 0.0:
            self._radius_m = radius_m
        moves = _distance(x_m, y_m, turn_rad, radius_m) > SLOWEST_M and (
            max(rigid_share, self._visible_share) >= ONE_BODY
            or (recent_share >= ONE_BODY and self._moves_in_turn(state.node_xy_m, shares * self.visible))
        )
        self._as_one_body.follow(moves, x_m, y_m, turn_rad)
        self._slips = moves and self.slid_px > SLIP_PX

    def _moves_in_turn(self, node_xy_m: Floats, seen_n: Floats) -> bool:
        """Whether an object slides under which nodes stick and let go in turn; seen_n: force on the visible ones."""
        return bool(_rigid_motion(node_xy_m, self._slid_m.sum(axis=0), seen_n)[0] >= MOSTLY)

    @property
    def slid_px(self) -> float:
        """How far the object has slid as one body in the present gross slip, rms over the visible contact."""
        return self._as_one_body.distance_m(self._radius_m) * self._px_per_m

    def truth(self) -> dict[str, Any]:
        """What of the truth of a slice is about slip; schema paths."""
        every_node_slid_m = self._every_node.distance_m(0.0) if self._every_node.moves else 0.0
        return {
            "truth/slid_px": self.slid_px,
            "truth/slip": self._slips,
            "truth/every_node_slid_px": every_node_slid_m * self._px_per_m,
            "truth/slip_share": self._share,
            "truth/visible_slip_share": self._visible_share,
        }


class _Slide:
    """A slide of the object over the gel: its translation and rotation since it began."""

    def __init__(self) -> None:
        self.moves = False
        self._x_m = self._y_m = self._turn_rad = 0.0
        self._rests_for = 0

    def follow(self, moves: bool, x_m: float, y_m: float, turn_rad: float) -> None:
        """Add the motion of a slice, or count it as rest; the slide ends after a few slices of rest."""
        self.moves = moves
        if moves:
            self._x_m += x_m
            self._y_m += y_m
            self._turn_rad += turn_rad
            self._rests_for = 0
            return
        self._rests_for += 1
        if self._rests_for > EPISODE_MS:
            self._x_m = self._y_m = self._turn_rad = 0.0

    def distance_m(self, radius_m: float) -> float:
        """Root mean square of how far points have slid whose rms distance from the contact's middle is radius_m."""
        return _distance(self._x_m, self._y_m, self._turn_rad, radius_m)


def _distance(x_m: float, y_m: float, turn_rad: float, radius_m: float) -> float:
    return math.sqrt(x_m * x_m + y_m * y_m + (turn_rad * radius_m) ** 2)


def visible_nodes(node_xy_m: Floats, mm_per_px: float, window_px: tuple[int, int, int, int] | None) -> Flags:
    """Which nodes (rows, columns) the camera sees: those in the frame, and not in the window of a cut gel."""
    at_px = node_xy_m * 1e3 / mm_per_px + np.array(FRAME_PX) / 2
    visible: Flags = _inside(at_px, (0, 0), FRAME_PX)
    if window_px is not None:
        visible &= ~_inside(at_px, window_px[:2], window_px[2:])
    return visible


def _inside(at_px: Floats, low: tuple[int, int], high: tuple[int, int]) -> Flags:
    inside: Flags = np.all((at_px >= np.array(low)) & (at_px < np.array(high)), axis=-1)
    return inside


@njit(cache=True, _nrt=False)
def _rigid_motion(nodes: Floats, slid: Floats, weights: Floats) -> tuple[float, float, float, float, float]:
    """The translation and rotation that explain the motion of nodes best: weighted least squares.

    Returns the share of the squared motion that they explain, the rms distance of the nodes from their middle, the
    motion of that middle, x and y, and the rotation; all 0 where there are no weights.
    """
    whole = middle_x = middle_y = square = x_m = y_m = spin = motion = 0.0
    rows, columns = weights.shape
    for row in range(rows):
        for column in range(columns):
            weight = weights[row, column]
            if weight > 0.0:
                x = nodes[row, column, 0]
                y = nodes[row, column, 1]
                slid_x = slid[row, column, 0]
                slid_y = slid[row, column, 1]
                whole += weight
                middle_x += weight * x
                middle_y += weight * y
                square += weight * (x * x + y * y)
                x_m += weight * slid_x
                y_m += weight * slid_y
                spin += weight * (x * slid_y - y * slid_x)
                motion += weight * (slid_x * slid_x + slid_y * slid_y)
    if whole == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    middle_x /= whole
    middle_y /= whole
    x_m /= whole
    y_m /= whole
    spread = max(square / whole - middle_x * middle_x - middle_y * middle_y, 0.0)
    rotation = 0.0
    if spread > 1e-12:  # a contact wider than 1 um
        rotation = (spin / whole - (middle_x * y_m - middle_y * x_m)) / spread
    rigid = x_m * x_m + y_m * y_m + rotation * rotation * spread
    share = rigid * whole / motion if motion > 0.0 else 0.0
    return share, math.sqrt(spread), x_m, y_m, rotation


@njit(cache=True, _nrt=False)
def _relative_motion(
    nodes: Floats,
    displacement: Floats,
    before: Floats,
    slid: Floats,
    rested_for: NDArray[np.int64],
    pose: Floats,
    pose_before: Floats,
    nodal: Floats,
    visible: Flags,
    stuck: Flags,
    seen_nodal: Floats,
) -> tuple[tuple[float, float, float, float, float], float, tuple[float, float, float, float, float]]:
    """How the object has moved against the gel since pose_before, node by node; weights are the normal forces.

    displacement: the gel's. before, rested_for: that before and for how many slices each node has not slid, both of
    which are brought up to now. slid: filled with the motion of the object's surface against each node, 0 where it
    bears nothing. seen_nodal: filled with the forces of visible nodes.
    Returns the share that slips, of all nodes and of the visible ones, and of all nodes the number that stick and the
    mean motion x, y; the share of the visible ones that slid within RECENT_MS; and their rigid motion. All are 0
    without contact.
    """
    move_x = pose[0] - pose_before[0]
    move_y = pose[1] - pose_before[1]
    turn = pose[2] - pose_before[2]
    force = slipping = sticking = mean_x = mean_y = seen = seen_slipping = recent = 0.0
    rows, columns = nodal.shape
    for row in range(rows):
        for column in range(columns):
            load = nodal[row, column]
            slid_x = slid_y = seen_load = 0.0
            if load > 0.0:
                slid_x = move_x - turn * (nodes[row, column, 1] - pose_before[1])
                slid_y = move_y + turn * (nodes[row, column, 0] - pose_before[0])
                slid_x -= displacement[row, column, 0] - before[row, column, 0]
                slid_y -= displacement[row, column, 1] - before[row, column, 1]
                square_m2 = slid_x * slid_x + slid_y * slid_y
                rested_for[row, column] = 0 if square_m2 > SLOWEST_M * SLOWEST_M else rested_for[row, column] + 1
                slips = 0.0 if stuck[row, column] else load
                force += load
                slipping += slips
                sticking += stuck[row, column]
                mean_x += load * slid_x
                mean_y += load * slid_y
                if visible[row, column]:
                    seen_load = load
                    seen += load
                    seen_slipping += slips
                    recent += load if rested_for[row, column] < RECENT_MS else 0.0
            else:
                rested_for[row, column] += 1
            seen_nodal[row, column] = seen_load
            slid[row, column, 0] = slid_x
            slid[row, column, 1] = slid_y
            before[row, column, 0] = displacement[row, column, 0]
            before[row, column, 1] = displacement[row, column, 1]
    if force == 0.0:
        return (0.0, 0.0, 0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0, 0.0, 0.0)
    visible_share = seen_slipping / seen if seen > 0.0 else 0.0
    whole = (slipping / force, visible_share, sticking, mean_x / force, mean_y / force)
    recent_share = recent / seen if seen > 0.0 else 0.0
    return whole, recent_share, _rigid_motion(nodes, slid, seen_nodal)
