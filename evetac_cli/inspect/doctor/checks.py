"""The rows of doctor: a check each, and how they are printed."""

import itertools
from typing import Any

from evetac_cli.console import print_text
from evetac_cli.jobs import Outcome, Row


def check(device: str, check: str, ok: bool | None, result: str, expected: str = "", fix: str = "") -> Row:
    """Return the row of a check. ok: None if it is neither right nor wrong; fix: what to do unless it is right."""
    return {
        "device": device,
        "check": check,
        "ok": ok,
        "found": result,
        "expected": expected or None,
        "fix": fix if fix and ok is not True else None,
    }


def show(result: Outcome, **_: Any) -> None:
    """Print a block for each device: what is right, what is wrong, and how to fix it."""
    counts = result.summary
    for device, group in itertools.groupby(result.rows, key=lambda row: str(row["device"])):
        print_text(device)
        for row in group:
            sign = {True: "ok", False: "WRONG", None: "-"}[row["ok"]]
            expected = f"  (expected: {row['expected']})" if row["ok"] is not True and row["expected"] else ""
            print_text(f"  {sign:<6}{row['check']:<15} {row['found']}{expected}")
            if row["fix"]:
                print_text(f"        {'':<16}try: {row['fix']}")
    if counts.get("cameras") == 0:
        print_text(
            "no camera found on USB. If one is plugged in, try another port or cable (some cables only carry power);"
        )
        print_text("`lsusb -d 152a:` shows whether the system sees it. Simulated and virtual devices need no camera.")
    if counts.get("grippers") == 0:
        print_text(
            "no gripper found. By default doctor only checks FTDI adapters (U2D2): give another port with"
            " --gripper PORT."
        )
    print_text(f"{counts['wrong']} wrong" if counts["wrong"] else "no faults found")
