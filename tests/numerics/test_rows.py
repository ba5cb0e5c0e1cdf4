"""Rows of the stability suites: one shape, and a refusal is no failure."""

from evetac_cli.numerics.rows import Rows

ROWS = Rows(("steps", "residual"))


def test_rows_of_a_suite_have_its_figures():
    """Assert that a row has the columns of its suite, None where the case does not have the figure."""
    row = ROWS.row("x", True, "finite", residual=0.5)
    assert list(row.items()) == [
        ("case", "x"), ("ok", True), ("outcome", "finite"), ("steps", None), ("residual", 0.5)
    ]  # fmt: skip
    assert ROWS.in_words("x", lambda: row) is row
    assert list(ROWS.refusal("x", lambda: None)) == list(row)


def test_a_refusal_and_a_failure_are_told_apart():
    """Assert that ValueError with words is a refusal, and any other exception, or one without words, is not ok."""

    def refuse():
        raise ValueError("expected less")

    def divide():
        return 1 / 0

    def silent():
        raise ValueError

    assert ROWS.refusal("x", refuse)["outcome"] == "refused: expected less"
    assert ROWS.refusal("x", refuse)["ok"]
    assert ROWS.refusal("x", divide)["outcome"] == "failed: ZeroDivisionError: division by zero"
    assert not ROWS.refusal("x", divide)["ok"]
    assert not ROWS.refusal("x", silent)["ok"]
    assert ROWS.refusal("x", lambda: None)["outcome"] == "accepted"
    assert not ROWS.refusal("x", lambda: None)["ok"]
