"""Bounds of the stability suite: rows by hand, and how refusals, failures and acceptances are told apart."""

import math

import pytest

from evetac_cli.errors import InputError
from evetac_cli.evaluate.stability.bounds import REFUSED, Bound, case_rows, run_case

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
