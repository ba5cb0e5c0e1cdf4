"""Pack what the published figures rest on into one archive that a data repository can store under a DOI.

    python scripts/ship/archive.py [dist/evetac-results-VERSION.tar.gz]

It has the tables, models and rows of docs/results, the rows of the paper, what was frozen, which seeds constants saw,
the licence, CITATION.cff, a README (docs/cite.md) and SHA256SUMS, which `sha256sum --check` reads. Only committed files
are packed; files of the tree that differ from the last commit are an error. The bytes depend on the commit alone.
"""

import argparse
import gzip
import hashlib
import io
import sys
import tarfile
from pathlib import Path

from evetac_cli import __version__
from evetac_cli.store.hdf5.disk import taking_the_place_of
from scripts.reproduce.frozen import git

ROOT = Path(__file__).resolve().parents[2]
PACKED = (
    "docs/results", "scripts/paper/rows.json", "scripts/reproduce/frozen.json", "scripts/reproduce/seeds.json",
    "CITATION.cff", "LICENSE",
)  # fmt: skip
README, SUMS, COMMIT = "docs/cite.md", "SHA256SUMS", "COMMIT"
LARGEST = 100_000_000  # bytes


def contents() -> dict[str, bytes]:
    """Return path -> content of all files of the archive, SHA256SUMS last."""
    if changed := git("status", "--porcelain", "--", *PACKED, README).decode():
        raise SystemExit(f"error: commit these first, or put them back:\n{changed.rstrip()}")
    names = git("ls-files", "-z", "--", *PACKED).decode().rstrip("\0").split("\0")
    files = {name: (ROOT / name).read_bytes() for name in sorted(names)}
    files |= {"README.md": (ROOT / README).read_bytes(), COMMIT: git("rev-parse", "HEAD")}
    return files | {SUMS: checksums(files)}


def checksums(files: dict[str, bytes]) -> bytes:
    """Return the lines of SHA256SUMS."""
    return "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items()).encode()


def pack(files: dict[str, bytes], archive: Path) -> None:
    """Write files into an archive, below a folder of its name."""
    folder = archive.name.removesuffix(".tar.gz")
    archive.parent.mkdir(parents=True, exist_ok=True)
    with (
        taking_the_place_of(archive) as temporary,
        temporary.open("wb") as raw,
        gzip.GzipFile("", "wb", mtime=0, fileobj=raw) as packed,
        tarfile.open(fileobj=packed, mode="w") as tar,
    ):
        for name, content in files.items():
            entry = tarfile.TarInfo(f"{folder}/{name}")
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))


def main() -> None:
    """Write the archive; SystemExit if it is too large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usual = ROOT / "dist" / f"evetac-results-{__version__}.tar.gz"
    parser.add_argument("archive", type=Path, nargs="?", default=usual, help="file to write, NAME.tar.gz")
    archive: Path = parser.parse_args().archive
    files = contents()
    pack(files, archive)
    if (size := archive.stat().st_size) > LARGEST:
        raise SystemExit(f"error: {archive} has {size / 1e6:.0f} MB, expected at most {LARGEST / 1e6:.0f} MB")
    sys.stdout.write(f"{archive}: {len(files)} files, {size / 1e6:.1f} MB\n")


if __name__ == "__main__":
    main()
