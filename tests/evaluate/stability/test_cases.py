"""Rows of cases by hand, how refusals and failures are told apart; that each extreme scene is one of the schema."""

import json
import math
from dataclasses import replace

import jsonschema
import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.stability.cases import (
    LIFTS,
    REFUSED,
    SLIP_SOON,
    SLIPS,
    Bound,
    case_rows,
    merge,
    run_case,
)
from evetac_cli.resources import schemas
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.scene import LightSettings, LightStep
from evetac_cli.sim.setup.tables import as_table

LENGTH = Bound("length", 2.0, "mm", "no more fits in")


def ok(rows):
    return [row["ok"] for row in rows]


def test_a_row_for_every_bound():
    """Assert that a row says what was measured, how much it may be and why, after the columns that group cases."""
    rows = case_rows("long", "bent", [(LENGTH, 3.0), (REFUSED, 0.0)], preset="paper")
    assert rows[0] == {
        "preset": "paper", "case": "long", "ok": False, "quantity": "length", "value": 3.0, "bound": 2.0, "unit": "mm",
        "outcome": "bent", "reason": "no more fits in",
    }  # fmt: skip
    assert ok(rows) == [False, True]


@pytest.mark.parametrize(("value", "within"), [(2.0, True), (2.1, False), (math.nan, False), (math.inf, False)])
def test_what_is_not_finite_is_within_no_bound(value, within):
    """Assert that a bound includes its end, and that NaN is within none."""
    assert ok(case_rows("x", "", [(LENGTH, value)])) == [within]


def test_a_refusal_is_no_failure():
    """Assert that an error with words is a refusal, and any other exception, or one without words, is not ok."""

    def refuse():
        raise ValueError("expected less")

    def refuse_input():
        raise InputError("a rate out of range", where="--control-hz")

    def divide():
        return 1 / 0

    def silent():
        raise ValueError

    (row,) = run_case("x", refuse, part="gel")
    assert (row["part"], row["case"], row["ok"], row["outcome"]) == ("gel", "x", True, "refused: expected less")
    assert ok(run_case("x", refuse_input)) == [True]
    (failed,) = run_case("x", divide)
    assert failed["outcome"] == "failed: ZeroDivisionError: division by zero"
    assert not any(ok([failed, *run_case("x", silent)]))


ALL = [("slip", name, SLIPS[name]) for name in SLIPS] + [("lift", name, LIFTS[name]) for name in LIFTS]


@pytest.mark.parametrize(("base", "name", "tables"), ALL, ids=[f"{base}: {name}" for base, name, _ in ALL])
def test_an_extreme_scene_is_a_scene(base, name, tables):
    """Assert that the merged scene is valid, and differs from the scene unless it is the usual one."""
    planned = first_plan(base)
    changed = merge(planned, SLIP_SOON, tables) if base == "slip" else merge(planned, tables)
    jsonschema.validate(as_table(changed.scene), json.loads((schemas() / "scene.v1.json").read_text()))
    assert (merge(planned, tables) == planned) == (name == "as usual")


def test_scenes_are_merged_into_the_plan():
    """Assert that a table's keys come beside or instead of the scene's own, and that the plan given stays as it was."""
    slip = first_plan("slip")
    step = {"at_s": 4.0, "factor": 0.5}
    merged = merge(slip, {"gripper": {"start_factor": [5.0, 6.0], "backlash_ticks": 2.0}}, {"light": {"step": step}})
    gripper = replace(slip.scene.gripper, start_factor=(5.0, 6.0), backlash_ticks=2.0)
    light = LightSettings(step=LightStep(**step))
    assert merged == replace(slip, scene=replace(slip.scene, gripper=gripper, light=light))
    assert slip == first_plan("slip") != merged
