"""scripts/ship/archive.py: the archive has every table, and its checksums are those of its files."""

import hashlib
import tarfile
from pathlib import Path

from scripts.reproduce import frozen
from scripts.ship import archive


def test_the_archive_has_what_its_checksums_say(tmp_path: Path) -> None:
    """Assert checksums, equal bytes from equal files, and that an archive opens below a folder of its name."""
    files = {"docs/results/a.json": b"{}", "README.md": b"read me"}
    first, again = tmp_path / "x-1.tar.gz", tmp_path / "again" / "x-1.tar.gz"
    for path in (first, again):
        archive.pack(files, path)
    assert first.read_bytes() == again.read_bytes()
    with tarfile.open(first) as tar:
        assert tar.getnames() == ["x-1/docs/results/a.json", "x-1/README.md"]
        readme = tar.extractfile("x-1/README.md")
        assert readme is not None and readme.read() == b"read me"


def test_what_is_packed_exists() -> None:
    """Assert that tables, models, rows and citation are committed files, and that each is in the list of checksums."""
    packed = frozen.git("ls-files", "--", *archive.PACKED).decode().split()
    assert {"docs/results/force.json", "scripts/paper/rows.json", "CITATION.cff", "LICENSE"} <= set(packed)
    assert any(name.startswith("docs/results/models/") for name in packed)
    assert all((archive.ROOT / name).exists() for name in (*archive.PACKED, archive.README))
    sums = archive.checksums({"a": b"1", "b": b"2"}).decode().splitlines()
    assert sums == [f"{hashlib.sha256(text).hexdigest()}  {name}" for name, text in (("a", b"1"), ("b", b"2"))]
