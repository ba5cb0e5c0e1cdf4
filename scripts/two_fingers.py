"""Run grasps with a camera at each finger: outcomes, lateness, and slip at one finger alone.

    python scripts/two_fingers.py --part simulated --seeds 57000-57019 -o rows.jsonl   # also with one camera
    python scripts/two_fingers.py --part unlike --seeds 57000-57019 -o rows.jsonl
    python scripts/two_fingers.py --part virtual --seeds 57020-57024 -o rows.jsonl
    python scripts/two_fingers.py --part prepared --seeds 57025-57027 -o rows.jsonl
    python scripts/two_fingers.py --table -o rows.jsonl                                # docs/results/grip-two-fingers*

- `simulated`: objects and sensors as a seed draws them in grip_trials.py, without a disturbance. The sensor of the
  second finger differs from the first: `evetac`, or the randomized sensor of the seed's number if the first is
  `evetac`.
- `virtual`: the same on virtual devices in real time; if the computer is too slow, the virtual world waits.
- `prepared`: two virtual cameras that play random events by the computer's clock, which does not wait. It measures how
  fast and how late both detectors are.
- `unlike`: an object between a soft gel that holds it well and a stiffer gel of low friction (UNLIKE), with a law that
  only closes on slip (ClosesOnSlip), in memory. It runs once with both fingers' signals and once without the second
  finger's, to test whether slip of the second finger alone has an effect.

Rows are written as grasps end, with the load of the computer; existing rows are not made again. All results are
simulated.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from grip_real_time import lateness, object_text
from grip_trials import BALANCE_S, LIFT_S, drawn
from real_time import grid
from script_rows import add_rows, rows_in, seeds_of
from script_tables import RESULTS, table_of, write

from evetac_cli.commands.grasp import Grasp
from evetac_cli.devices.simulated import rig
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.grip.control import Control, LawState, PluginLaw, SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim.setup.held import SecondFingerSettings
from evetac_cli.sim.setup.plan import NamedSensor, first_plan
from evetac_cli.store.files import StageFile
from evetac_cli.trials.grasp.loop import SliceDetector, grasp_slices
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from evetac_cli.trials.grasp.settings import GraspSettings
from evetac_cli.trials.grasp.two_fingers import TwoFingers

GRID = ("--node-pitch-mm", "1.45")
LOOP = ("--controller", "load-proportional", "--model", "shipped")
PAPER_LOOP = ("--controller", "paper", "--model", "shipped")  # for timing with random events
SHOWN = ("balanced", "failure", "force_end_n", "over_holding_end", "moved_mm", "slip_events", "false_slip_events")
# Chosen on seeds 1 to 7: the second finger slips some px as the object leaves the table, and the first sticks. The
# object slips at the second finger by as much as the first gel shears, so the first gel is soft.
UNLIKE = SecondFingerSettings(friction_factor=0.2, stiffness_factor=2.5)
SOFT, FRICTION, MASS_G, HOLDS_TICKS = 0.4, 3.0, 150.0, 4
UNLIKE_THRESHOLD, UNLIKE_LIFT_S = 0.1, 1.5
SOON_MS = 50  # counted from when the second finger has slid half a pixel
STICKS = 0.5  # largest slipping share of the first finger's contact while the second slips alone
EVENTS_S, PREPARED_S = 20_000, 20.0
CAMERAS = {"one": "{0}", "two": "{0},{0}"}


def command(folder: Path, *words: str) -> Row:
    """Run a grasp; return its row, or the reason why there is none."""
    before = os.getloadavg()[0]
    whole = ["grasp", *words, "--json", "-q", "-o", str(folder / "out")]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "evetac_cli", *whole], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        return {"failed": done.stderr.strip()[-300:] or f"exit code {done.returncode}", "load": before}
    row: Row = json.loads(done.stdout)["rows"][0]
    return row | {"load": before, "load_after": os.getloadavg()[0]}


def figures(row: Row) -> Row:
    """Return the outcome in a grasp's row and, for one in real time, its timing."""
    if "failed" in row:
        return row
    kept = {name: row[name] for name in (*SHOWN, "load", "load_after") if name in row}
    for finger, output in (("first", row["output"]), ("second", row.get("second_output"))):
        if output is None:
            continue
        with StageFile(Path(output), "recording") as file:
            kept[finger] = lateness(file)
            for name in ("slices_per_s", "clock_offset_us"):
                if file.has(f"capture/{name}"):
                    kept[finger][name] = float(file.read(f"capture/{name}"))
    for name in ("detector_core_share", "second_detector_core_share", "command_misses", "commands", "late_slices"):
        if name in row:
            kept[name] = row[name]
    return kept


def drawn_grasp(seed: int, how: str, device: str) -> Row:
    """Run a grasp of a seed's object and sensors, with a camera at one finger or at both."""
    one = drawn(seed)
    first = one.plan.sensor_name
    other = f"randomized:{seed}" if first == "evetac" else "evetac"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "object.toml").write_text(object_text(one))
        devices = ["--camera", CAMERAS[how].format(device), "--sensor", first if how == "one" else f"{first},{other}"]
        times = ["--lift-s", f"{LIFT_S:g}", "--balance-s", f"{BALANCE_S:g}", "--seed", str(seed), *GRID]
        return figures(command(Path(folder), *devices, *LOOP, "--object", "object.toml", *times))


def prepared_grasp(seed: int, how: str) -> Row:
    """Measure timing with cameras that play random events."""
    with tempfile.TemporaryDirectory() as folder:
        devices = ["--camera", CAMERAS[how].format(f"virtual:prepared={EVENTS_S}"), "--gripper", "virtual"]
        lift_s = PREPARED_S / 2
        times = ["--lift-s", f"{lift_s:g}", "--balance-s", f"{PREPARED_S - lift_s:g}", "--seed", str(seed)]
        return figures(command(Path(folder), *devices, *PAPER_LOOP, "--calibration", str(grid(Path(folder))), *times))


@dataclass
class ClosingState(LawState):
    """How far the law has closed on slip."""

    more_ticks: int = 0


@dataclass(frozen=True)
class ClosesOnSlip(PluginLaw):
    """Holds a number of ticks beyond first touch, and closes by one tick with each step that has slip.

    evetac's own laws do so much more that the effect of a slip signal alone would not be visible.
    """

    method: ClassVar[int] = 1
    approach_ticks: int = 2
    most_ticks: int = 20

    def start(self, control_hz: float) -> ClosingState:
        """Return the state before the first step."""
        return ClosingState()

    def step(self, state: Any, phase: GraspPhase, slip: bool, signal: SlipSignal, position_ticks: int) -> int:
        """Return the goal position."""
        if phase is GraspPhase.CONTACT:
            state.x_ref = float(position_ticks)
            return position_ticks + self.approach_ticks
        if slip:
            state.more_ticks = min(state.more_ticks + 1, self.most_ticks)
        return int(state.x_ref) + HOLDS_TICKS + state.more_ticks


class Blind:
    """Two fingers of which only the first one's signal reaches the controller."""

    def __init__(self, both: TwoFingers, first: OnlineSlipDetector) -> None:
        self._first = first
        self.step, self.tell_gripper = both.step, both.tell_gripper

    @property
    def signal(self) -> SlipSignal:
        """Return the signal for the controller."""
        return self._first.signal


def unlike_grasp(seed: int, how: str) -> Row:
    """Test whether slip of the second finger alone has an effect; `one` hides its signal from the controller."""
    plan = first_plan("lift", "11")
    assert plan.touched is not None
    scene = replace(
        plan.scene,
        gripper=replace(plan.scene.gripper, second_finger=UNLIKE),
        gel=replace(plan.scene.gel, stiffness_factor=SOFT),
    )
    touched = replace(plan.touched, static_friction=FRICTION, mass_g=MASS_G)
    plan = replace(plan, scene=scene, touched=touched, second=NamedSensor(plan.sensor_name, plan.sensor))
    times = {"lift_s": UNLIKE_LIFT_S, "balance_s": 0.0}
    settings = GraspSettings.of(
        Grasp(controller="paper", model=Path("shipped"), slip_threshold=UNLIKE_THRESHOLD, **times)
    )
    devices = rig(plan, np.random.SeedSequence(seed), **times)
    assert settings.detector is not None and devices.second is not None
    first, second = (settings.detector.open(each.sensor) for each in (devices.camera, devices.second.camera))
    truths: list[Any] = []
    of_second = devices.second
    both = TwoFingers(first, second, of_second.camera, lambda _: truths.append(of_second.truth()))
    told: SliceDetector = both if how == "two" else Blind(both, first)
    timing = settings.timing(plan.scene.time.touch_s)
    rows = [row for _, row in grasp_slices(devices, told, Control(ClosesOnSlip()), timing)]
    sticks = np.array([not row["truth/slip"] and row["truth/slip_share"] < STICKS for row in rows])
    slips = np.array([bool(row["truth/slip"]) for row in truths])
    alone = np.flatnonzero(slips & sticks)
    answers = [at for at, row in enumerate(rows) if row.get("control/slip") and at >= timing.touch_ms]
    return {
        "alone_ms": int(alone[0]) if len(alone) else None,
        "told_ms": answers[:1],
        "slid_px": float(max(row["truth/slid_px"] for row in truths)),
        "first_slips": bool(any(row["truth/slip"] for row in rows[timing.touch_ms :])),
        "force_touch_n": float(rows[timing.touch_ms + 100]["truth/normal_force_n"]),
        "force_end_n": float(rows[-1]["truth/normal_force_n"]),
    }


PARTS = {
    "simulated": lambda seed, how: drawn_grasp(seed, how, "sim"),
    "virtual": lambda seed, how: drawn_grasp(seed, how, "virtual"),
    "prepared": prepared_grasp,
    "unlike": unlike_grasp,
}
HOWS = {"simulated": ("one", "two"), "unlike": ("one", "two"), "virtual": ("two",), "prepared": ("one", "two")}


def medians(values: Sequence[float | None]) -> float | None:
    """Return the median of the available values."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def grasps_table(rows: Rows) -> Row:
    """Return the table of outcomes and lateness."""
    shown = []
    words = {
        "simulated": "simulated",
        "virtual": "virtual devices, in real time",
        "prepared": "prepared events, in real time",
    }
    for part, name in words.items():
        for how in HOWS[part]:
            some = [row for row in rows if (row["part"], row["how"]) == (part, how)]
            made = [row for row in some if "failed" not in row]
            if not some:
                continue
            late = {
                finger: [row[finger]["slice_late_us"] for row in made if "slice_late_us" in row.get(finger, {})]
                for finger in ("first", "second")
            }
            line: Row = {"what": name, "fingers": {"one": 1, "two": 2}[how], "grasps": len(made)}
            line["failed"] = len(some) - len(made)
            grasped = [row for row in made if "balanced" in row]
            line["kept"] = sum(row["balanced"] for row in grasped) if grasped else None
            line["over"] = medians([row["over_holding_end"] for row in grasped])
            line["moved"] = medians([row["moved_mm"] for row in grasped])
            line["reactions"] = float(np.mean([row["slip_events"] for row in grasped])) if grasped else None
            for finger in ("first", "second"):
                line[f"{finger}_per_s"] = medians([row.get(finger, {}).get("slices_per_s") for row in made])
                for index, percentile in enumerate(("p50", "p99")):
                    ms = medians([each[index] / 1e3 for each in late[finger]])
                    line[f"{finger}_{percentile}_ms"] = ms
            line["core"] = medians([row.get("detector_core_share") for row in made])
            line["load"] = medians([row.get("load") for row in made])
            shown.append(line)
    columns = {
        "grasps": "{what}",
        "fingers that see": "{fingers}",
        "made": "{grasps}",
        "failed": "{failed}",
        "kept": "{kept}",
        "force at the end over what just holds, median": "{over:.2f}",
        "moved, median [mm]": "{moved:.2f}",
        "reactions per grasp": "{reactions:.1f}",
        "slices per s, first and second finger": "{first_per_s:.0f}, {second_per_s:.0f}",
        "first finger's slices late, median, 99th percentile [ms]": "{first_p50_ms:.2f}, {first_p99_ms:.2f}",
        "second finger's": "{second_p50_ms:.2f}, {second_p99_ms:.2f}",
        "a detector takes of a core": "{core:.2f}",
        "load of the computer before": "{load:.1f}",
    }
    seeds = {part: [row["seed"] for row in rows if row["part"] == part] for part in words}
    named = {part: f"{min(each)}-{max(each)}" for part, each in seeds.items() if each}
    commands = " and ".join(f"--part {part} --seeds {each}" for part, each in named.items())
    note = (
        f"The second finger's sensor differs from the first's. Prepared events, {EVENTS_S:,} per s and camera, arrive"
        " by the computer's clock; the other virtual devices wait for a computer that is too slow. All on 2 cores that"
        " other programs shared; the load counts processes that run or wait for a core."
    )
    title, sizes = "Grasps with a camera at each finger", {"seeds": named}
    whole = f"python scripts/two_fingers.py {commands} -o FILE"
    return table_of("grip-two-fingers", title, columns, shown, whole, sizes, notes=(note,))


def unlike_table(rows: Rows) -> Row:
    """Return the table of reactions to slip at one of two unlike fingers."""
    shown = []
    for how, words in (("two", "yes"), ("one", "no")):
        some = [row for row in rows if (row["part"], row["how"]) == ("unlike", how)]
        alone = [row for row in some if row["alone_ms"] is not None]
        waits = [row["told_ms"][0] - row["alone_ms"] for row in alone if row["told_ms"]]
        soon = [wait for wait in waits if wait <= SOON_MS]
        shown.append(
            {
                "sees": words,
                "grasps": len(some),
                "alone": len(alone),
                "soon": len(soon),
                "late": len(waits) - len(soon),
                "wait_ms": medians(waits),
                "slid_px": medians([row["slid_px"] for row in alone]),
                "force_n": medians([row["force_touch_n"] for row in some]),
                "end_n": medians([row["force_end_n"] for row in some]),
                "first": sum(row["first_slips"] for row in some),
            }
        )
    columns = {
        "the second finger sees": "{sees}",
        "grasps": "{grasps}",
        "in which it slips alone": "{alone}",
        f"the grip answers within {SOON_MS} ms": "{soon}",
        "later": "{late}",
        "after its slip began, median [ms]": "{wait_ms:.0f}",
        "slid at the second finger, median [px]": "{slid_px:.1f}",
        "grip before and at the end, median [N]": "{force_n:.2f}, {end_n:.2f}",
        "the first finger slips, too": "{first}",
    }
    seeds = sorted({row["seed"] for row in rows if row["part"] == "unlike"})
    named = f"{seeds[0]}-{seeds[-1]}"
    note = (
        f"The first finger's gel is {SOFT:g} times as stiff as usual and its friction {FRICTION:g}; the second's is as"
        f" stiff as usual, its friction {FRICTION * UNLIKE.friction_factor:.1g}. A law holds {HOLDS_TICKS} ticks beyond"
        " touch and closes one tick with each step of 2 ms in which the detector reaches the threshold of"
        f" {UNLIKE_THRESHOLD:g}. The second finger slips alone if at least half of the first one's contact sticks."
    )
    command = f"python scripts/two_fingers.py --part unlike --seeds {named} -o FILE"
    title = "Slip at the second of two unlike fingers"
    return table_of("grip-two-fingers-unlike", title, columns, shown, command, {"seeds": named}, notes=(note,))


def main() -> None:
    """Run the missing grasps of a part, or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=PARTS)
    parser.add_argument("--seeds", type=seeds_of, help="FIRST-LAST")
    parser.add_argument("--table", action="store_true", help="write the tables into docs/results")
    parser.add_argument("-o", "--out", type=Path, required=True, help="JSON lines, one per grasp")
    chosen = parser.parse_args()
    if chosen.part is not None and chosen.seeds is None:
        parser.error("--part needs --seeds")
    for seed in chosen.seeds if chosen.part is not None else ():
        for how in HOWS[chosen.part]:
            known = {(row["part"], row["how"], row["seed"]) for row in rows_in(chosen.out)}
            if (chosen.part, how, seed) not in known:
                add_rows(chosen.out, [{"part": chosen.part, "how": how, "seed": seed, **PARTS[chosen.part](seed, how)}])
    if chosen.table:
        rows = rows_in(chosen.out)
        write(RESULTS, grasps_table(rows), unlike_table(rows))


if __name__ == "__main__":
    main()
