"""No test depends on how fast the machine is: whatever is waited for has PATIENCE_S, and wall time is never judged."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.patience import PATIENCE_S, until

TESTS = Path(__file__).resolve().parent
# What runs in real time has limits of its own there, with the reason beside each.
IN_REAL_TIME = (TESTS / "devices", TESTS / "trials" / "grasp")
WAITS = ("wait", "join", "communicate")  # methods whose first argument, or `timeout`, is a limit
CLOCKS = ("monotonic", "perf_counter")
MAY_WAIT = re.compile(rf"timeout=|[.](?:{'|'.join(WAITS)})[(][\w.]|{'|'.join(CLOCKS)}")
MODULES = [path for path in sorted(TESTS.rglob("*.py")) if not any(folder in path.parents for folder in IN_REAL_TIME)]


def short_limits(tree: ast.Module) -> Iterator[ast.expr]:
    """What is given as the limit of a wait, and is a number below PATIENCE_S, or stands for one in this module.

    One that is called SILENCE_S may be short: after it, nothing is still expected to come.
    """
    numbers = {
        name.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for name in node.targets
        if isinstance(name, ast.Name) and name.id != "SILENCE_S"
    }
    for limit in limits(tree):
        number = numbers.get(limit.id) if isinstance(limit, ast.Name) else limit
        if isinstance(number, ast.Constant) and isinstance(number.value, (int, float)) and number.value < PATIENCE_S:
            yield limit


def limits(tree: ast.Module) -> Iterator[ast.expr]:
    """What is given as the limit of a wait."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield from (word.value for word in node.keywords if word.arg in ("timeout", "request_timeout"))
            if isinstance(node.func, ast.Attribute) and node.func.attr in WAITS:
                yield from node.args[:1]


def judged_times(tree: ast.Module) -> Iterator[ast.Assert]:
    """Assertions that so much time has passed at most since another moment."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert) and isinstance(node.test, ast.Compare):
            passed, bound = node.test.left, node.test.ops[0]
            clocks = [part for part in ast.walk(passed) if isinstance(part, ast.Attribute) and part.attr in CLOCKS]
            if clocks and isinstance(passed, ast.BinOp) and isinstance(bound, (ast.Lt, ast.LtE)):
                yield node


def test_whatever_is_waited_for_has_time() -> None:
    """Assert that no limit of a wait is a number of the test's own, and that no test judges how long something took."""
    texts = {path.relative_to(TESTS): path.read_text() for path in MODULES}
    trees = {path: ast.parse(text) for path, text in texts.items() if MAY_WAIT.search(text)}
    assert len(trees) > 20
    assert [
        f"{path}:{node.lineno}: {ast.unparse(node)}"
        for path, tree in trees.items()
        for node in (*short_limits(tree), *judged_times(tree))
    ] == []


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("run.wait(5)", 1),
        ("thread.join(0.5)", 1),
        ("run.communicate(timeout=60)", 1),
        ("subprocess.run(words, timeout=100.0)", 1),
        ("GIVE_UP_S = 60; run.wait(timeout=GIVE_UP_S)", 1),
        ("SILENCE_S = 5; rpc(timeout=SILENCE_S)", 0),
        ("run.wait(PATIENCE_S); run.wait(); thread.join(); ', '.join(words); run(timeout=3600)", 0),
        ("assert time.monotonic() - began_s < 5.0", 1),
        ("assert time.perf_counter() - began_s <= 2 * before_s", 1),
        ("assert time.monotonic() < end_s", 0),
        ("assert time.monotonic() - began_s >= 0.1", 0),
    ],
)
def test_short_limits_are_found(code: str, count: int) -> None:
    """Assert that a limit is found however it is given, and a lower bound is none."""
    tree = ast.parse(code)
    assert len([*short_limits(tree), *judged_times(tree)]) == count


def test_examples_have_time_too() -> None:
    """Assert that neither drawing examples nor trying one is judged by how long it takes."""
    used = settings.default
    assert used is not None
    assert used.deadline is None
    assert HealthCheck.too_slow in used.suppress_health_check


def test_until_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a condition is waited for, and one that never comes ends in False."""
    came = iter([False, False, True])
    assert until(lambda: next(came), every_s=0.0)
    monkeypatch.setattr("tests.patience.PATIENCE_S", 0.0)
    assert not until(lambda: False)
