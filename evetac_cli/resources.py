"""Where the package's own data lies: schemas, scenes, tables, a slip detector."""

import functools
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, InputError

PACKAGE = Path(__file__).resolve().parent
DATA = PACKAGE / "data"
SCENES = DATA / "scenes"
SHIPPED = "shipped"  # names the package's model where a flag asks for one
MODEL = DATA / "models" / "slip-10ms.model.h5"  # the slip detector of `grasp`; its report lies beside it
STICKING_MODEL = DATA / "models" / "sticking.npz"  # of touch maps; what it was trained on lies beside it


def schemas() -> Path:
    """The folder of schemas: inside an installed package, else one folder up (an editable install)."""
    for candidate in (PACKAGE / "schemas", PACKAGE.parent / "schemas"):
        if candidate.is_dir():
            return candidate
    raise EvetacError("the folder schemas/ is missing from this installation", hint="install evetac again")


def model_file(named: Path | str | None, flag: str = "--model") -> Path:
    """The file of a slip detector: the package's for `shipped` and where none is named, otherwise what is named.

    InputError for a name that is neither a file nor `shipped`, but near to it.
    """
    if named is None or str(named) in ("", SHIPPED):
        return MODEL
    path = Path(named)
    if not path.exists() and get_close_matches(str(named), [SHIPPED]):
        raise InputError("no such file", where=flag, found=str(named), hint=f"did you mean {SHIPPED}?")
    return path


def with_shipped(files: Iterable[Path]) -> list[Path]:
    """Files as they were named, in which `shipped` stands for the package's slip detector, at the end.

    A file or folder that is called so is meant where there is one.
    """
    named = list(files)
    others = [path for path in named if str(path) != SHIPPED or path.exists()]
    return others if len(others) == len(named) else [*others, MODEL]


@functools.cache
def table(name: str) -> dict[str, Any]:
    """A TOML table of the package: objects, sensors."""
    import tomllib

    return tomllib.loads((DATA / f"{name}.toml").read_text())
