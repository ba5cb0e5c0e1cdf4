"""Paths of the package's own data: schemas, scenes, tables, the pretrained slip detector."""

import functools
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, InputError

PACKAGE = Path(__file__).resolve().parent
DATA = PACKAGE / "data"
SCENES = DATA / "scenes"
SHIPPED = "shipped"  # name of the pretrained model in flags
MODEL = DATA / "models" / "slip-10ms.model.h5"  # the slip detector of `grasp`; its report is next to it
STICKING_MODEL = DATA / "models" / "sticking.npz"  # of touch maps; a description of its training is next to it


def schemas() -> Path:
    """Return the folder of schemas: inside an installed package, or one folder up (an editable install)."""
    for candidate in (PACKAGE / "schemas", PACKAGE.parent / "schemas"):
        if candidate.is_dir():
            return candidate
    raise EvetacError("the folder schemas/ is missing from this installation", hint="reinstall evetac")


def model_file(name_or_path: Path | str | None, flag: str = "--model") -> Path:
    """Return the file of a slip detector: the pretrained one for `shipped` or no name, otherwise the named file.

    InputError for a name that is not a file and looks like a misspelt `shipped`.
    """
    if name_or_path is None or str(name_or_path) in ("", SHIPPED):
        return MODEL
    path = Path(name_or_path)
    if not path.exists() and get_close_matches(str(name_or_path), [SHIPPED]):
        raise InputError("no such file", where=flag, found=str(name_or_path), hint=f"did you mean {SHIPPED}?")
    return path


def with_shipped(files: Iterable[Path]) -> list[Path]:
    """Return the named files, with `shipped` replaced by the pretrained slip detector, at the end.

    If a file or folder named `shipped` exists, it is used instead.
    """
    all_files = list(files)
    others = [path for path in all_files if str(path) != SHIPPED or path.exists()]
    return others if len(others) == len(all_files) else [*others, MODEL]


@functools.cache
def table(name: str) -> dict[str, Any]:
    """Return a TOML table of the package: objects or sensors."""
    import tomllib

    return tomllib.loads((DATA / f"{name}.toml").read_text())
