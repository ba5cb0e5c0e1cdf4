"""scripts/try_dockerfile.py: how it reads the Dockerfile and .dockerignore; the image itself is tried by hand."""

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import try_dockerfile

ROOT = try_dockerfile.ROOT


def test_instructions_are_joined_and_without_comments() -> None:
    """Assert words and arguments of lines that go on, and that comments between them are no part of them."""
    text = '# a\nFROM x\n\nRUN one \\\n    && two\n# b\nENTRYPOINT ["evetac"]\n'
    assert try_dockerfile.instructions(text) == [("FROM", "x"), ("RUN", "one && two"), ("ENTRYPOINT", '["evetac"]')]


def test_the_dockerfile_of_the_clone() -> None:
    """Assert a base and instructions that the script knows, and that the image runs evetac, and not as root."""
    lines = try_dockerfile.instructions((ROOT / "Dockerfile").read_text())
    assert lines[0][0] == "FROM" and lines[0][1] in try_dockerfile.SUITES
    assert lines[-1] == ("ENTRYPOINT", '["evetac"]')
    assert [rest for word, rest in lines if word == "USER"] == ["evetac"]
    assert {word for word, _ in lines} <= {"FROM", "COPY", "RUN", "ENV", "USER", "WORKDIR", "ENTRYPOINT"}


def test_the_context_is_what_the_package_is_built_from() -> None:
    """Assert that code, data, schemas and what pyproject.toml names are seen, and nothing else of the clone."""
    seen = {str(path) for path in try_dockerfile.context((ROOT / ".dockerignore").read_text())}
    assert {"pyproject.toml", "constraints.txt", "README.md", "evetac_cli/py.typed"} <= seen
    assert any(name.startswith("schemas/") for name in seen) and "evetac_cli/data/objects.toml" in seen
    assert not [name for name in seen if "__pycache__" in name or name.split("/")[0] in ("tests", "docs", "scripts")]


def test_nobody_may_write_what_others_load() -> None:
    """Assert that no line gives everybody rights to a folder, but to one in which each owns what is theirs."""
    lines = try_dockerfile.instructions((ROOT / "Dockerfile").read_text())
    text = "\n".join(rest for _, rest in lines)
    assert not re.search(r"a\+|o\+|(?<!1)777|0666|=/tmp", text)
    compiled = next(number for number, (_, rest) in enumerate(lines) if "doctor --compile" in rest)
    assert compiled < [word for word, _ in lines].index("USER")  # as root, whose the source is


def test_a_folder_of_others_is_no_image(tmp_path: Path) -> None:
    """Assert that root does not fill, and run, what others can write to, or below it."""
    inside = tmp_path / "a" / "image"
    inside.mkdir(parents=True)
    for path in (tmp_path, inside.parent, inside):
        path.chmod(0o755)
    try_dockerfile.require_own(inside)
    try_dockerfile.require_own(inside / "new")
    for shared in (inside, inside.parent, tmp_path):
        shared.chmod(0o777)
        with pytest.raises(SystemExit, match="other users can write"):
            try_dockerfile.require_own(inside)
        shared.chmod(0o1777)
        if shared is inside:
            with pytest.raises(SystemExit, match="other users can write"):
                try_dockerfile.require_own(inside)
        else:
            try_dockerfile.require_own(inside)
        shared.chmod(0o755)
