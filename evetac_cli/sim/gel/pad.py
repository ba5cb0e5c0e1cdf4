"""A pad as compiled code takes it: a few arrays, and by name all that is in them.

Each array takes time to pass, so what a step changes is one block of memory, as is what it needs to search the balance.
`parts_of` names the parts of both blocks: for compiled code, and once per `gel.GelState`, uncompiled, for Python.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.sheet import SheetStencil

# A gel is at rest if all its motion is slower than this and the pull of its Maxwell arms is weaker. Such motion would
# shift a dot by 1e-18 px, but positions resolve only 1e-14 px. Displacements below SMALLEST_M are set to 0.
SLOWEST_M_S = 1e-20
WEAKEST_N = 1e-22
SMALLEST_M = 1e-21

OBJECT = 9  # numbers of the object: its inertia, pose and twist

# Constants of a pad, in SI units.
CONSTANTS = np.dtype(
    [
        ("node_mass", np.float64),
        ("shear", np.float64),  # a node's spring to the back
        ("spring", np.float64),  # a node's spring to the sheet
        ("pitch_x", np.float64),  # distances between nodes
        ("pitch_y", np.float64),
        ("viscous_time", np.float64),  # of the dashpot
        ("maxwell_share", np.float64),  # of the fast arm
        ("maxwell_time", np.float64),
        ("pads", np.float64),  # how many pads like this one hold the object
        *((name, np.float64) for name in SheetStencil._fields),
    ]
)


Arrays = tuple[Floats, Floats, Floats, NDArray[np.void], Floats, Floats, Flags]  # the values of PadArrays


class PadArrays(NamedTuple):
    """Arrays of a pad and of the object on it.

    node_xy_m: (rows, columns, 2). creep_arms: (arms, 2), share and time in s of each slow arm. sheet_rule: see `sheet`.
    constants: (1,), of dtype CONSTANTS. state, memory: see `PadParts`. sticks: (2, rows, columns), now and before.
    """

    node_xy_m: Floats
    creep_arms: Floats
    sheet_rule: Floats
    constants: NDArray[np.void]
    state: Floats
    memory: Floats
    sticks: Flags


class Work(NamedTuple):
    """Memory for one step, (rows, columns[, 2]); `loose`, sheet, sheet_search and after have a border all around.

    The pad keeps it from step to step, because allocating it took a tenth of a step.

    velocity: mean velocity of the nodes over the step, the unknown; right: right-hand side of their equation.

    lever: position of the nodes relative to the object's centre; bound: mu * normal force.

    pull: the friction that each node needs; slip, speed: its velocity against the object's surface, and its magnitude.

    loose: 1 for a node that does not move with the object. search_direction: response of the nodes to a motion of the
    object.

    The sheet's arrays have x and y separately (2, ...): `sheet` is its mean velocity, `sheet_search` its response to a
    motion, and `sheet_source` the pull of the nodes on it.

    sheet_left, search_left: residuals of the balances of sheet and sheet_search. after: one component in the middle of
    a sweep.

    normal: normal force of each node, for a slice in many steps. twist: (3,), of the object, the other unknown.
    """

    velocity: Floats
    right: Floats
    lever: Floats
    bound: Floats
    pull: Floats
    slip: Floats
    speed: Floats
    loose: Floats
    search_direction: Floats
    sheet: Floats
    sheet_search: Floats
    sheet_source: Floats
    sheet_left: Floats
    search_left: Floats
    after: Floats
    sheet_rule: Floats
    normal: Floats
    twist: Floats


class PadParts(NamedTuple):
    """Views of a pad's arrays; those of its state are explained in `gel.GelState`.

    mean_m_s, sheet_m_s: velocity of nodes and sheet over the last step. stuck_before: before the present step.
    """

    inertia: Floats
    pose: Floats
    twist: Floats
    displacement_m: Floats
    velocity_m_s: Floats
    maxwell_n: Floats
    mean_m_s: Floats
    creep_n: Floats
    slip_m_s: Floats
    friction_coefficient: Floats
    sheet_m: Floats
    sheet_m_s: Floats
    stuck: Flags
    stuck_before: Flags
    node_xy_m: Floats
    creep_arms: Floats
    work: Work


def empty_pad(node_xy_m: Floats, creep_arms: Floats, sheet_rule: Floats, constants: NDArray[np.void]) -> PadArrays:
    """Return a pad whose state is 0 everywhere."""
    rows, columns, _ = node_xy_m.shape
    plain, bordered, longer = rows * columns, (rows + 2) * (columns + 2), rows * (columns + 2)
    state = np.zeros(OBJECT + (10 + 2 * len(creep_arms)) * plain + 4 * bordered)
    memory = np.zeros(3 + 15 * plain + 6 * bordered + 6 * longer)
    sticks = np.zeros((2, rows, columns), dtype=np.bool_)
    return PadArrays(node_xy_m, creep_arms, sheet_rule, constants, state, memory, sticks)


@njit(cache=True, _nrt=False)
def parts_of(pad: PadArrays) -> PadParts:
    """Return the parts of a pad's arrays."""
    state, memory = pad.state, pad.memory
    _, rows, columns = pad.sticks.shape
    arms = pad.creep_arms.shape[0]
    plain, border, row = rows * columns, (rows + 2) * (columns + 2), rows * (columns + 2)
    singles_at = OBJECT + (8 + 2 * arms) * plain
    sheets_at = singles_at + 2 * plain
    pairs = state[OBJECT:singles_at].reshape(4 + arms, rows, columns, 2)
    singles = state[singles_at:sheets_at].reshape(2, rows, columns)
    sheets = state[sheets_at:].reshape(2, 2, rows + 2, columns + 2)
    work_rows_at = 6 * border
    work_pairs_at = work_rows_at + 6 * row
    work_singles_at = work_pairs_at + 12 * plain
    work_sheets = memory[border : 5 * border].reshape(2, 2, rows + 2, columns + 2)
    work_rows = memory[work_rows_at:work_pairs_at].reshape(3, 2, row)
    work_pairs = memory[work_pairs_at:work_singles_at].reshape(6, rows, columns, 2)
    work_singles = memory[work_singles_at : work_singles_at + 3 * plain].reshape(3, rows, columns)
    work = Work(
        velocity=work_pairs[0],
        right=work_pairs[1],
        lever=work_pairs[2],
        pull=work_pairs[3],
        slip=work_pairs[4],
        search_direction=work_pairs[5],
        bound=work_singles[0],
        speed=work_singles[1],
        normal=work_singles[2],
        loose=memory[:border].reshape(rows + 2, columns + 2),
        sheet=work_sheets[0],
        sheet_search=work_sheets[1],
        after=memory[5 * border : work_rows_at],
        sheet_source=work_rows[0],
        sheet_left=work_rows[1],
        search_left=work_rows[2],
        sheet_rule=pad.sheet_rule,
        twist=memory[work_singles_at + 3 * plain :],
    )
    return PadParts(
        inertia=state[0:3],
        pose=state[3:6],
        twist=state[6:9],
        displacement_m=pairs[0],
        velocity_m_s=pairs[1],
        maxwell_n=pairs[2],
        mean_m_s=pairs[3],
        creep_n=pairs[4:],
        slip_m_s=singles[0],
        friction_coefficient=singles[1],
        sheet_m=sheets[0],
        sheet_m_s=sheets[1],
        stuck=pad.sticks[0],
        stuck_before=pad.sticks[1],
        node_xy_m=pad.node_xy_m,
        creep_arms=pad.creep_arms,
        work=work,
    )


@njit(cache=True, _nrt=False)
def settle(arrays: Arrays) -> bool:
    """Set velocities and Maxwell forces to 0 if all are below the thresholds; return whether they are."""
    parts = parts_of(PadArrays(*arrays))
    moving, lately, stretching = parts.velocity_m_s.reshape(-1), parts.mean_m_s.reshape(-1), parts.sheet_m_s.reshape(-1)
    lagging, moved, creeping = parts.maxwell_n.reshape(-1), parts.displacement_m.reshape(-1), parts.creep_n.reshape(-1)
    stretched = parts.sheet_m.reshape(-1)
    for k in range(len(moving)):
        if abs(moving[k]) > SLOWEST_M_S or abs(lately[k]) > SLOWEST_M_S or abs(lagging[k]) > WEAKEST_N:
            return False
    for k in range(len(stretching)):
        if abs(stretching[k]) > SLOWEST_M_S:
            return False
    for k in range(len(creeping)):
        if abs(creeping[k]) > WEAKEST_N:
            return False
    creeping[:] = 0.0
    for k in range(len(moving)):
        moving[k] = 0.0
        lately[k] = 0.0
        lagging[k] = 0.0
        if abs(moved[k]) < SMALLEST_M:
            moved[k] = 0.0
    for k in range(len(stretching)):
        stretching[k] = 0.0
        if abs(stretched[k]) < SMALLEST_M:
            stretched[k] = 0.0
    return True
