"""The list of public facts: complete, consistent with the paper's figures, and how ours compare with it."""

import re
from collections import Counter

import pytest

from evetac_cli import resources
from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.likeness.facts import (
    FIT,
    NEAR,
    OFF,
    PREDICTION,
    UNTOLD,
    WITHIN,
    Fact,
    by_name,
    constant_of,
    facts,
)


def fact(**what: object) -> Fact:
    """A fact with what a test is about, the rest in words."""
    words = dict.fromkeys(("name", "fact", "public", "source", "command"), "words")
    return Fact(**{**words, "kind": PREDICTION, **what})  # type: ignore[arg-type]


def test_the_list_is_whole() -> None:
    """Assert that nineteen facts are counted, that each class has some, and that each says source and command."""
    assert [one.counts for one in facts() if one.counts] == list(range(1, 20))
    assert len({one.name for one in facts()}) == len(facts()) >= 25
    kinds = Counter(one.kind for one in facts())
    assert set(kinds) == {FIT, PREDICTION, UNTOLD} and kinds[PREDICTION] > kinds[FIT]
    for one in facts():
        assert one.fact and one.public and one.source and one.command, one.name
        assert one.needs or one.command.startswith("none"), one.name


def test_of_the_counted_one_of_tracking_and_one_of_data_rate_was_fitted() -> None:
    """Assert that the counted facts are predictions, but for one of four on lost dots and one of three data rates."""
    fitted = {one.name for one in facts() if one.counts and one.kind != PREDICTION}
    assert fitted == {"tracked-regularised", "data-rate-slip"}


def test_each_fact_says_where_ours_comes_from() -> None:
    """Assert that ours comes from known measures, tables and constants, and that a fitted fact says what it fitted."""
    for one in facts():
        assert bool(one.table) == bool(one.value_of), one.name
        assert one.fits if one.kind == FIT else not one.fits, one.name
        if one.constant:
            assert constant_of(one.constant), one.name
        assert all(low <= high for low, high in zip(one.low, one.high, strict=True)), one.name


def test_figures_of_the_paper_are_those_of_the_one_list() -> None:
    """Assert that a fact of the paper has its figure and spread: the printed sd, or Wilson's interval of a share."""
    share = by_name("tracked-unregularised")
    assert share.value == (PAPER.value("consistent", "unregularised"),) == (0.2,)
    assert share.low[0] == pytest.approx(0.057, abs=1e-3) and share.high[0] == pytest.approx(0.510, abs=1e-3)
    rate = by_name("data-rate-contact")
    assert (rate.low[0], rate.high[0]) == pytest.approx((0.020, 0.036))


def test_ours_compares_within_near_or_off() -> None:
    """Assert that a figure is within the spread, else half to twice by sign, else off; nothing is said of none."""
    one = fact(value=(10.0,), low=(9.0,), high=(11.0,))
    assert [one.compare((value,)) for value in (9.5, 5.0, 20.0, 20.1, 4.9, -10.0)] == [
        WITHIN, NEAR, NEAR, OFF, OFF, OFF,
    ]  # fmt: skip
    assert one.compare((None,)) is None and one.compare(()) is None
    assert fact(low=(0.0,), high=(1.0,)).compare((1.5,)) == OFF  # only ends are published
    assert fact(value=(2.0,)).compare((2.0,)) == NEAR  # no spread is published
    assert fact().compare((3.0,)) is None


def test_several_figures_hold_together() -> None:
    """Assert that all figures of a fact count, that one that is off decides, and one that is missing leaves it open."""
    two = fact(value=(1.0, 4.0), low=(0.9, 3.0), high=(1.1, 5.0))
    assert two.compare((1.0, 4.0)) == WITHIN
    assert two.compare((1.0, 6.0)) == NEAR
    assert two.compare((1.0, 9.0)) == OFF
    assert two.compare((3.0, None)) == OFF
    assert two.compare((1.0, None)) is None
    assert fact(low=(0.3,), high=(1.0,)).compare((0.75, 0.95)) == WITHIN  # one range for all figures


def test_what_constants_are_fitted_to_is_on_the_list() -> None:
    """Assert that a comment `fitted to NAME` names a fact, and one that may be fitted to."""
    named = [
        (path.name, name)
        for pattern in ("*.py", "*.toml")
        for path in resources.PACKAGE.rglob(pattern)
        for name in re.findall(r"fitted to `?([a-z0-9]+(?:-[a-z0-9]+)+)\b", path.read_text())
    ]
    kinds = {one.name: one.kind for one in facts()}
    assert [(where, name, kinds.get(name)) for where, name in named if kinds.get(name) != FIT] == []
