"""What an HDF5 file must not do to its reader: lead into other files, announce what is not there, or lie elsewhere."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5
from evetac_cli.store.layout.provenance import Recipe
from tests.patience import PATIENCE_S

TEXT = """
import sys
from pathlib import Path
from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile
try:
    with StageFile(Path(sys.argv[1])) as file:
        file.read("command")
except InputError as error:
    peak_kb = int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
    print(peak_kb < 500_000, "a text of 4294967295 bytes" in str(error))
"""


def test_m6_announced_text_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Assert that a text of 4 GB, announced by a damaged length, is refused without the memory for it."""
    path = tmp_path / "a.report.h5"
    write_stage(path, Recipe("report", 1, {}), {"command": "evaluate slip", "rows": "[]", "summary": "{}"})
    with h5py.File(path) as h5:
        where = h5["command"].id.get_offset()
    content = bytearray(path.read_bytes())
    content[where : where + 4] = (2**32 - 1).to_bytes(4, "little")
    path.write_bytes(bytes(content))
    run = [sys.executable, "-c", TEXT, str(path)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.stdout, done.stderr) == ("True True\n", "")


HEAP = """
import sys
from pathlib import Path
from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile
for path in sys.argv[1:]:
    try:
        with StageFile(Path(path)) as file:
            assert file.read("command") == "evaluate slip" and file.read("rows") == "[]"
    except InputError as error:
        assert "cannot be read" in str(error), error
"""


def test_damage_among_texts_never_holds_the_reader_up(tmp_path: Path) -> None:
    """Assert that wrong sizes in the heap where HDF5 keeps texts, over which it runs in circles, end in words."""
    path = tmp_path / "a.report.h5"
    write_stage(path, Recipe("report", 1, {}), {"command": "evaluate slip", "rows": "[]", "summary": "{}"})
    whole = path.read_bytes()
    heap = whole.find(b"GCOL")
    damaged = []
    at = heap + 16
    while index := int.from_bytes(whole[at : at + 2], "little"):
        size = int.from_bytes(whole[at + 8 : at + 16], "little")
        for wrong in (size + 26, 2**63, 0):
            content = bytearray(whole)
            content[at + 8 : at + 16] = wrong.to_bytes(8, "little")
            damaged.append(tmp_path / f"{index}.{wrong}.report.h5")
            damaged[-1].write_bytes(bytes(content))
        at += 16 + -(-size // 8) * 8
    assert len(damaged) > 12  # three texts and the header; units and long names, which are not read
    run = [sys.executable, "-c", HEAP, *map(str, damaged)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("reference", [b"\x01\0\0\0" + b"\xff" * 12, b"\x0d\0\0\0" + bytes(12), bytes(16)])
def test_texts_that_lie_nowhere_end_in_words(tmp_path: Path, reference: bytes) -> None:
    """Assert that a text whose place no file has, or where something else lies, is named; one of no bytes is empty."""
    path = tmp_path / "a.report.h5"
    write_stage(path, Recipe("report", 1, {}), {"command": "evaluate slip", "rows": "[]", "summary": "{}"})
    with h5py.File(path) as h5:
        where = h5["command"].id.get_offset()
    content = bytearray(path.read_bytes())
    content[where : where + 16] = reference
    path.write_bytes(bytes(content))
    if any(reference):
        with StageFile(path) as file, pytest.raises(InputError, match="command cannot be read"):
            file.read("command")
    else:
        with StageFile(path) as file:
            assert file.read("command") == ""


@pytest.mark.parametrize("libver", ["earliest", "latest", ("earliest", "v114"), "v110"])
def test_texts_are_those_that_hdf5_reads(tmp_path: Path, libver: Any) -> None:
    """Assert that texts of any length and script come back, whichever version of the layout they are stored in."""
    texts = {"header": "x", "note": "Größe 触覚 \U0001f91a " * 3000, "empty": "", "long": "{}" * 100_000}
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver=libver) as h5:
        for number in range(0 if libver in ("latest", "v110") else 30):  # which keep more than 8 elsewhere
            h5.attrs[f"other {number}"] = "text"
        for name, text in texts.items():
            h5.attrs[name] = text
            h5[name] = text
        h5["fixed"] = np.bytes_(b"of fixed length")
    with CheckedHdf5(path) as file:
        datasets = file.datasets()
        for name, text in texts.items():
            assert file.text_attribute(name) == text
            assert file.text(name, datasets[name].id) == text
        assert file.text("fixed", datasets["fixed"].id) == "of fixed length"
        assert file.text_attribute("missing") is None
