"""Gross slip, the pad's last stuck node and incipient slip, for motions whose answer is known."""

import math

import numpy as np
import pytest

from evetac_cli.arrays import Flags, Floats
from evetac_cli.events import FRAME_PX
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.scenes.true_slip import EPISODE_MS, RECENT_MS, SLIP_PX, GroundTruthSlip, visible_nodes

MM_PER_PX = 0.0329
WINDOW_PX = (540, 0, 640, 480)
M_PER_PX = MM_PER_PX * 1e-3
END_M = (WINDOW_PX[0] - FRAME_PX[0] / 2) * M_PER_PX  # of a cut pad, at the window
NODES = contact.pad_nodes(48, 36, (END_M - 20e-3, END_M), (-7.5e-3, 7.5e-3))


class Trial:
    """An object on a pad that is moved by hand: what sticks is carried along, what slips stays where it is."""

    def __init__(self, load: Floats, middle_m: tuple[float, float] = (0.0, 0.0)) -> None:
        self.state = gel.start(NODES, gel.GelMaterial(), 0.1, 1e-5, body_xy_m=middle_m)
        self.slip = GroundTruthSlip(self.state, MM_PER_PX, WINDOW_PX)
        self.load = load

    def move(self, stuck: Flags, x_px: float = 0.0, y_px: float = 0.0, turn_rad: float = 0.0) -> dict[str, float]:
        """One slice: the object moves, and the gel with it where `stuck`; returns its truth."""
        from_middle = NODES - self.state.pose[:2]
        aside = np.stack([-from_middle[..., 1], from_middle[..., 0]], axis=-1)
        moved = np.array([x_px, y_px]) * M_PER_PX + turn_rad * aside
        self.state.displacement_m += moved * stuck[..., None]
        self.state.pose += [x_px * M_PER_PX, y_px * M_PER_PX, turn_rad]
        self.state.stuck[:] = stuck & (self.load > 0)
        self.slip.follow(self.state, self.load, float(self.load.sum()))
        return {name.removeprefix("truth/"): float(value) for name, value in self.slip.truth().items()}


def evenly() -> Floats:
    """As much force on every node, 1 N in all."""
    return np.full(NODES.shape[:2], 1.0 / NODES[..., 0].size)


def disc(radius_m: float) -> Flags:
    """The nodes in a disc about the middle of the view."""
    inside: Flags = np.linalg.norm(NODES, axis=-1) <= radius_m
    return inside


EVERYTHING = np.ones(NODES.shape[:2], dtype=np.bool_)
NOTHING = ~EVERYTHING
UNSEEN = NODES[..., 0] < -0.5 * FRAME_PX[0] * M_PER_PX


def test_what_the_camera_sees() -> None:
    """Assert that 2.2 mm of a cut pad lie outside the frame, that all else is seen, and nothing in a window."""
    np.testing.assert_array_equal(visible_nodes(NODES, MM_PER_PX, WINDOW_PX), ~UNSEEN)
    assert UNSEEN.mean() == pytest.approx(2.23 / 20, abs=1 / 48)
    closed = contact.pad_nodes(60, 36, (END_M - 20e-3, 0.5 * FRAME_PX[0] * M_PER_PX), (-7.5e-3, 7.5e-3))
    frame = closed[..., 0] >= -0.5 * FRAME_PX[0] * M_PER_PX
    np.testing.assert_array_equal(visible_nodes(closed, MM_PER_PX, None), frame)
    np.testing.assert_array_equal(visible_nodes(closed, MM_PER_PX, WINDOW_PX), frame & (closed[..., 0] < END_M))


def test_gel_that_is_carried_along_does_not_slip() -> None:
    """Assert that shear and rotation of a sticking contact, however far, are no slip of any kind."""
    trial = Trial(evenly(), (1e-3, 2e-3))
    for _ in range(50):
        truth = trial.move(EVERYTHING, 1.0, -0.5, 0.01)
        assert not any(truth.values())


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -1.0), (0.6, 0.8)])
def test_translation_is_counted_in_full(direction: tuple[float, float]) -> None:
    """Assert that both distances are that of an object which slides everywhere, and that slip begins beyond SLIP_PX."""
    trial = Trial(evenly())
    for count in range(1, 9):
        truth = trial.move(NOTHING, *(0.12 * part for part in direction))
        assert truth["slid_px"] == pytest.approx(0.12 * count)
        assert truth["every_node_slid_px"] == pytest.approx(0.12 * count)
        assert truth["slip"] == (0.12 * count > SLIP_PX)
        assert truth["slip_share"] == truth["visible_slip_share"] == 1.0


def test_rotation_on_the_spot_is_slip() -> None:
    """Assert that an object which turns about its contact's middle slides by angle times rms radius, R / sqrt 2."""
    radius_m, angle = 5e-3, 2e-3
    trial = Trial(disc(radius_m) * 1e-3)
    for count in range(1, 5):
        truth = trial.move(NOTHING, turn_rad=angle)
        assert truth["slid_px"] == pytest.approx(count * angle * radius_m / math.sqrt(2) / M_PER_PX, rel=0.02)
    assert truth["slip"]
    assert truth["every_node_slid_px"] < 0.05 * truth["slid_px"]  # the mean motion vanishes


@pytest.mark.parametrize(("stuck_part", "slips"), [(0.3, True), (0.4, True), (0.55, False), (0.9, False)])
def test_rotation_about_a_stuck_middle(stuck_part: float, slips: bool) -> None:
    """Assert that a stuck disc inside a turning contact hinders gross slip from 0.47 of its radius on (1 - s^4)."""
    radius_m = 5e-3
    trial = Trial(disc(radius_m) * 1e-3)
    for _ in range(20):
        truth = trial.move(disc(stuck_part * radius_m), turn_rad=2e-3)
    assert truth["slip"] == slips
    assert truth["visible_slip_share"] == pytest.approx(1 - stuck_part**2, abs=0.03)
    assert truth["every_node_slid_px"] == 0.0


@pytest.mark.parametrize(("stuck_part", "slips"), [(0.03, True), (0.1, False), (0.5, False), (0.95, False)])
def test_translation_past_stuck_gel(stuck_part: float, slips: bool) -> None:
    """Assert that slip is gross while less than a twentieth of the visible force rests on stuck gel."""
    trial = Trial(evenly())
    first = -0.5 * FRAME_PX[0] * M_PER_PX
    stuck = NODES[..., 0] < first + stuck_part * (END_M - first)
    for _ in range(20):
        truth = trial.move(stuck, 1.0)
    assert truth["slip"] == slips
    assert (truth["slid_px"] > SLIP_PX) == slips
    assert truth["visible_slip_share"] == pytest.approx(1 - stuck_part, abs=0.03)
    assert truth["every_node_slid_px"] == 0.0


@pytest.mark.parametrize(("turns", "slips"), [(2, True), (5, True), (RECENT_MS + 2, False)])
def test_nodes_that_stick_and_let_go_in_turn(turns: int, slips: bool) -> None:
    """Assert that an object slides as one body although its nodes slip one after the other, if often enough."""
    trial = Trial(evenly())
    column = np.broadcast_to(np.arange(NODES.shape[1]), NODES.shape[:2])
    said = []
    for slice_ in range(3 * turns):
        truth = trial.move(column % turns != slice_ % turns, 1.0)
        assert truth["every_node_slid_px"] == 0.0
        said.append(truth["slip"])
    assert all(said[turns + 1 :]) == slips
    assert any(said) == slips
    if slips:
        assert truth["slid_px"] == pytest.approx((2 * turns + 1) / turns, rel=0.1)


@pytest.mark.parametrize(("slides", "slips"), [(0.3, False), (0.7, True)])
def test_nodes_that_go_on_by_a_hair_now_and_then(slides: float, slips: bool) -> None:
    """Assert that nodes which let go for a moment, one after the other, make no gross slip while most of them stay.

    A share of the contact slides with the object; every node slips by 0.01 px in every fourth slice.
    """
    trial = Trial(evenly())
    column = np.broadcast_to(np.arange(NODES.shape[1]), NODES.shape[:2])
    said = []
    for slice_ in range(4 * RECENT_MS):
        stuck = column >= slides * NODES.shape[1]
        lets_go = column % 4 == slice_ % 4
        trial.state.displacement_m[stuck & lets_go, 0] -= 0.01 * M_PER_PX
        said.append(trial.move(stuck, 1.0)["slip"])
    assert any(said) == slips


def test_stuck_gel_that_no_camera_sees() -> None:
    """Assert that gel outside the frame does not hinder gross slip, and does hinder the last stuck node."""
    trial = Trial(evenly())
    for _ in range(3):
        truth = trial.move(UNSEEN, 0.3)
    assert truth["slip"]
    assert truth["slid_px"] == pytest.approx(0.9)
    assert truth["every_node_slid_px"] == 0.0
    assert truth["visible_slip_share"] == 1.0
    assert truth["slip_share"] == pytest.approx(1 - UNSEEN.mean())


def test_contact_that_no_camera_sees() -> None:
    """Assert that an object which slides outside the frame alone makes no gross slip, but a slide of every node."""
    trial = Trial(UNSEEN * 1e-3)
    for _ in range(3):
        truth = trial.move(NOTHING, 0.3)
    assert (truth["slip"], truth["slid_px"], truth["visible_slip_share"]) == (0, 0, 0)
    assert (truth["every_node_slid_px"], truth["slip_share"]) == (pytest.approx(0.9), 1.0)


@pytest.mark.parametrize("rests_ms", [EPISODE_MS, EPISODE_MS + 1])
def test_slip_ends_after_a_rest(rests_ms: int) -> None:
    """Assert that a slide goes on after a rest of EPISODE_MS, and that after a longer one it begins anew."""
    trial = Trial(evenly())
    for _ in range(4):
        before = trial.move(NOTHING, 0.2)
    assert before["slip"]
    for _ in range(rests_ms):
        rests = trial.move(EVERYTHING, 0.2)
        assert (rests["slip"], rests["every_node_slid_px"]) == (0, 0)
    after = trial.move(NOTHING, 0.2)
    goes_on = rests_ms <= EPISODE_MS
    assert after["slip"] == goes_on
    for name in ("slid_px", "every_node_slid_px"):
        assert after[name] == pytest.approx(1.0 if goes_on else 0.2)


def test_distances_are_those_of_the_gels_own_steps() -> None:
    """Assert that what is summed from poses and displacements is the slip velocity that every step reports.

    An upright cylinder of 100 g hangs in a grip that is loosened until it slides down.
    """
    state = gel.start(NODES, gel.GelMaterial(), 0.1, 1e-4)
    slip = GroundTruthSlip(state, MM_PER_PX, WINDOW_PX)
    gap_m = contact.gap_profile(NODES, "cylinder", 0.03, math.radians(0.2))
    friction = gel.Friction(0.8, 0.7, 0.01)
    slid_m, slides = 0.0, 0
    for slice_ in range(400):
        force_n = 1.4 - 0.0025 * slice_
        nodal_n = contact.pressure(2e-4, gap_m, force_n)
        info = gel.step(state, nodal_n, [0.1 * 9.81 * min(slice_ / 50, 1.0), 0.0, 0.0], friction, 1e-3)
        slip.follow(state, nodal_n, force_n)
        truth = slip.truth()
        assert truth["truth/slip_share"] <= 1.0
        assert (truth["truth/slip_share"] == 1.0) == (info.slip_fraction == 1.0)
        if info.slip_fraction == 1.0:
            slid_m, slides = slid_m + 1e-3 * info.slip_velocity_m_s[0], slides + 1
            assert truth["truth/every_node_slid_px"] == pytest.approx(slid_m / M_PER_PX, rel=1e-3)
        elif slides:
            break
    assert slides > 10
