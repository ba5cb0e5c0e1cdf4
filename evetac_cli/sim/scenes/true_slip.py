"""Ground truth of slip: gross slip over the contact that the camera sees, and the pad's last stuck node.

- Gross slip. The measure is the motion of the object's surface against the gel, node by node. A translation and a
  rotation are fitted to this relative motion over the visible contact, weighted by pressure. The object slides as one
  body in a slice if the fit explains ONE_BODY of the motion's mean square, or if ONE_BODY of the pressure is on
  slipping nodes. It also does if that much pressure is on nodes that slid within the last RECENT_MS slices, and a fit
  to the summed motion of these slices explains MOSTLY of it. The fitted motions are summed over such slices, and slip
  is gross beyond SLIP_PX. Gross slip ends when the object has not slid as one body for more than EPISODE_MS slices.
- Last stuck node. The same distance, but of the mean motion over the whole pad, counted from the time when no loaded
  node sticks, visible or not. It is stored as truth/every_node_slid_px.
- Incipient slip: the share of the normal force on slipping nodes, of the visible contact and of the whole contact.

A node is visible if at rest it is in the frame and not in the window of a cut gel.

Why a fit. The mean of the relative motion alone would count incipient slip as gross, because the edges slide for many
pixels while the rest sticks. The last stuck node alone may bear almost nothing, or be outside the frame. If a part f of
the pressure sticks during a translation, the fit explains 1 - f, so a twentieth may stick. A rotation about the
contact's middle leaves nodes there stuck for long, because they hardly have to move. A stuck disc of 0.45 of the
contact's radius reduces the explained part by 4 %, although the object slips.

Why also the pressure on slipping nodes. The fit alone would be late: when all nodes let go the gel relaxes unevenly,
and for some slices its motion is not that of a rigid body (object 6 of seed 3).

Why the last RECENT_MS slices. The nodes that stick at one instant alone would hide slides. Under a heavy object (20 of
seed 10100) that slid at 40 mm/s, nodes stuck and let go in turn every 3 to 6 ms. Almost never did all of them slip at
once. But it is not enough that each node moved a little in that time. If nodes are too far apart to resolve unstable
slip, all of them move now and then while most stick. Under 2 kg whose weight is handed over (`evaluate stability sim`)
this moves the object by 4 px in 100 ms, and then it comes to rest. Translation and rotation explain at most 0.45 of the
motion within RECENT_MS, which is motion of one edge of the contact. For object 20, seed 3, which continued to slide,
they explain 0.58 by the time it has slid half a pixel.

The distance is the root mean square over the visible contact. Without rotation it is the distance of the translation.
For an object that turns on the spot it does not vanish, as the mean would. The maximum would depend on a node at the
rim that bears almost nothing.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.gel import GelState

SLIP_PX = 0.5  # distance beyond which an object that slides as one body slips: the onset
ONE_BODY = 0.95  # least share of the squared relative motion, or of the pressure, for sliding as one body
RECENT_MS = 10  # slices within which nodes stick and let go in turn while an object slides
MOSTLY = 0.5  # least share of the squared relative motion within RECENT_MS for an object that slides
EPISODE_MS = 3  # gross slip ends after more than this many slices in which the object does not slide as one body
SLOWEST_M = 1e-9  # least motion in a slice that is not rest, 1 um/s
CONTACT_N = 0.01  # least normal force of a contact

# Ground truth of every slice of vibrating scenes, in which everything sticks.
NO_SLIP = {
    "truth/slid_px": 0.0,
    "truth/slip": False,
    "truth/every_node_slid_px": 0.0,
    "truth/slip_share": 0.0,
    "truth/visible_slip_share": 0.0,
}


class GroundTruthSlip:
    """Follows object and gel slice by slice; `truth` returns the slip at the end of the last slice."""

    def __init__(self, state: GelState, mm_per_px: float, window_px: tuple[int, int, int, int] | None) -> None:
        """Start with a gel and an object that have not moved yet; window_px is None for a closed gel."""
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
        """Add one slice; shares: each node's share of the normal force force_n, (rows, columns)."""
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
        """Return whether the object slides while nodes stick and let go in turn; seen_n: force on visible nodes."""
        return bool(_rigid_motion(node_xy_m, self._slid_m.sum(axis=0), seen_n)[0] >= MOSTLY)

    @property
    def slid_px(self) -> float:
        """Return how far the object has slid as one body in the present gross slip, rms over the visible contact."""
        return self._as_one_body.distance_m(self._radius_m) * self._px_per_m

    def truth(self) -> dict[str, Any]:
        """Return the slip in the ground truth of a slice, by schema path."""
        every_node_slid_m = self._every_node.distance_m(0.0) if self._every_node.moves else 0.0
        return {
            "truth/slid_px": self.slid_px,
            "truth/slip": self._slips,
            "truth/every_node_slid_px": every_node_slid_m * self._px_per_m,
            "truth/slip_share": self._share,
            "truth/visible_slip_share": self._visible_share,
        }


class _Slide:
    """A slide of the object over the gel: translation and rotation since its start."""

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
        """Return the rms distance that points have slid; radius_m: their rms distance from the contact's middle."""
        return _distance(self._x_m, self._y_m, self._turn_rad, radius_m)


def _distance(x_m: float, y_m: float, turn_rad: float, radius_m: float) -> float:
    return math.sqrt(x_m * x_m + y_m * y_m + (turn_rad * radius_m) ** 2)


def visible_nodes(node_xy_m: Floats, mm_per_px: float, window_px: tuple[int, int, int, int] | None) -> Flags:
    """Return which nodes (rows, columns) the camera sees: those in the frame and not in the window of a cut gel."""
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
    """Fit a translation and a rotation to the motion of nodes by weighted least squares.

    Return the share of the squared motion that they explain, the rms distance of the nodes from their middle, the
    motion of that middle along x and y, and the rotation. All are 0 without weights.
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
    """Compute the object's motion against the gel since pose_before, node by node; weights are the normal forces.

    displacement: of the gel now. before, rested_for: the gel's displacement before, and the number of slices since each
    node last slid; both are updated.

    slid: filled with the motion of the object's surface against each node, 0 for unloaded nodes. seen_nodal: filled
    with the forces of visible nodes.

    The first result is, over all nodes, the share of force that slips; the same for visible nodes; and over all nodes
    the number that stick and the mean motion x, y. The second is the share of the visible force on nodes that slid
    within RECENT_MS. The third is the rigid motion of the visible nodes. All are 0 without contact.
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
