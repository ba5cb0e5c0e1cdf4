"""scripts/first_hour.py: blocks of a page are run in one shell, and what they print is held to the page."""

import os
from pathlib import Path

from scripts import first_hour

PAGE = """# A page

```sh
cd /
echo 'f1: 0.84'
```

<!-- expect f1 0.8..1 -->
<!-- expect lost dots -1..0 -->

```text
old
```

    not run

```sh
pwd; echo '| lost dots | 1,234 |'
```

```text
```
"""


def test_blocks_are_run_in_one_shell(tmp_path: Path) -> None:
    """Assert that a folder is kept from block to block, and that each block's output is told from the others'."""
    code, printed = first_hour.run(first_hour.blocks(PAGE), tmp_path, dict(os.environ))
    assert (code, printed) == (0, ["f1: 0.84\n", "/\n| lost dots | 1,234 |\n"])


def test_a_command_that_fails_ends_the_page(tmp_path: Path) -> None:
    """Assert that the exit code is that of the command, also in a pipe, and that later blocks are not run."""
    page = first_hour.blocks("```sh\necho a\n```\n```sh\n(exit 3) | cat\n```\n```sh\necho c\n```\n")
    assert first_hour.run(page, tmp_path, dict(os.environ)) == (3, ["a\n", ""])


def test_figures_are_held_to_their_ranges() -> None:
    """Assert that a figure in its range passes, and that one outside, or one that is missing, is named."""
    block, _ = first_hour.blocks(PAGE)
    assert first_hour.faults(block, "f1: 0.84\n│ lost dots │ -0.5 │") == []
    assert first_hour.faults(block, "f1: 0.79\n| lost dots | 1,234 |") == [
        "f1: expected 0.8 to 1, found 0.79",
        "lost dots: expected -1 to 0, found 1234",
    ]
    assert first_hour.faults(block, "af1: 0.9") == [
        "f1: expected 0.8 to 1, found none",
        "lost dots: expected -1 to 0, found none",
    ]


def test_outputs_are_put_below_their_blocks() -> None:
    """Assert that only the block of text right below is replaced, and that the rest of the page stays."""
    written = first_hour.with_outputs(PAGE, ["f1: 0.9\n", "\n".join(map(str, range(100)))])
    assert written.count("f1: 0.9\n") == 1
    assert "old" not in written
    assert "0\n1\n2\n" in written and f"{first_hour.MOST_LINES - 1}\n...\n```\n" in written
    assert first_hour.with_outputs(PAGE, []) == PAGE
