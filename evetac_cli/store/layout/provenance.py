"""The identity of a result: its recipe, the hash of the recipe (recipe id), and the header that stores both in a file.

Two files with the same id have the same numbers on the same type of machine, so a stage whose output already has the id
of the wanted recipe has nothing to do. The id covers the kind, its major version (minor ones only add), the method
version of the stage, every parameter, the seed and the parents' ids. A recording from a device or a file cannot be made
again from a recipe: the hash of its stored arrays replaces the seed. Time, host and versions of libraries are also
stored but are not part of the id.
"""

import hashlib
import json
import platform
import re
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from evetac_cli import plugins
from evetac_cli.errors import ForeignFile, InputError, SchemaError, made_by
from evetac_cli.names import __version__
from evetac_cli.store.hdf5.checked_hdf5 import MOST_TEXT_BYTES, CheckedHdf5
from evetac_cli.store.layout import ancestry, schema
from evetac_cli.text_files import SEED_BITS, parse_json

Header = ancestry.Header
LEAST_SHARED = 64  # characters; a reference to the list takes some 20


def canonical(value: Any) -> str:
    """Return JSON with sorted keys and no blanks; ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


@dataclass(frozen=True)
class Recipe:
    """Everything that determines the content of a stage file."""

    kind: str
    method: int
    parameters: dict[str, Any]
    seed: int | None = None
    parents: tuple[Header, ...] = ()
    content: str | None = None
    simulated_source: bool = False

    @property
    def identity(self) -> dict[str, Any]:
        """The parts that determine a result, as JSON values; the id is their hash."""
        return {
            "kind": self.kind,
            "major": schema.MAJOR,
            "method": self.method,
            "parameters": self.parameters,
            "seed": self.seed,
            "content": self.content,
            "simulated": self.simulated,
            "parents": [parent["id"] for parent in self.parents],
        }

    @property
    def simulated(self) -> bool:
        """Whether the file, or any of its ancestors, comes from a simulation."""
        return self.simulated_source or any(parent["simulated"] for parent in self.parents)

    @property
    def id(self) -> str:
        """The recipe id, 64 hexadecimal digits."""
        return hashlib.sha256(canonical(self.identity).encode()).hexdigest()

    def header(self) -> Header:
        """Return the header of a file made now from this recipe, with the history of its parents, each once.

        What is behind trained files is in tables (ancestry.py), and not in a recording of a grasp: some megabytes.
        """
        history: dict[str, Header] = {}
        for parent in self._carried_parents():
            history.update(parent["history"])
            history[parent["id"]] = {k: v for k, v in parent.items() if k not in ("history", "made")}
        header = {
            "kind": self.kind,
            "version": schema.load(self.kind).version,
            "method": self.method,
            "parameters": self.parameters,
            "seed": self.seed,
            "parents": [parent["id"] for parent in self.parents],
            "content": self.content,
            "id": self.id,
            "simulated": self.simulated,
            "history": history,
            "made": time_host_versions(),
        }
        return ancestry.without_training_files(header)

    def carried(self) -> "Recipe":
        """Return the recipe without the history that its header leaves out; both have the same header."""
        return replace(self, parents=self._carried_parents())

    def _carried_parents(self) -> tuple[Header, ...]:
        if self.kind != "recording":
            return self.parents
        return tuple(
            {k: v for k, v in each.items() if k not in ancestry.TABLES} | {"history": {}}
            if each["kind"] == "model"
            else each
            for each in self.parents
        )


def folded(header: Header) -> Header:
    """Return the header as stored in a file: parameters common to several ancestors are stored once, in `shared`.

    Such an ancestor has, in addition to its own `parameters`, `shared`: name of a parameter -> index in that list. The
    reason: a report has hundreds of recordings of few scenes, whose parameters are most of its header. The rows of a
    trained ancestor are there too: `trajectories` is their index. Those of a trained file are data sets.
    """
    header = {key: value for key, value in header.items() if key not in ancestry.TABLES}
    ancestors = header["history"].values()
    counts = Counter(canonical(value) for ancestor in ancestors for value in ancestor["parameters"].values())
    texts = {text for text, count in counts.items() if count > 1 and len(text) >= LEAST_SHARED}
    places: dict[str, int] = {}
    history = {}
    for id_, ancestor in sorted(header["history"].items()):
        text_by_name = {name: canonical(value) for name, value in ancestor["parameters"].items()}
        shared = {name: places.setdefault(text, len(places)) for name, text in text_by_name.items() if text in texts}
        own = {name: value for name, value in ancestor["parameters"].items() if name not in shared}
        history[id_] = {**ancestor, "parameters": own, "shared": shared} if shared else dict(ancestor)
        if "trajectories" in ancestor:
            history[id_]["trajectories"] = places.setdefault(canonical(ancestor["trajectories"]), len(places))
    return {**header, "history": history, "shared": [json.loads(text) for text in places]} if places else header


def unfolded(header: Header, most_characters: int) -> Header:
    """Return the whole header from one as stored in a file; an error if `shared` is invalid or expands to too much.

    Ancestors refer to the same shared parameters, not to copies.
    """
    values = header.pop("shared", [])
    sizes = [len(canonical(value)) for value in values]
    for ancestor in header.get("history", {}).values():
        shared = ancestor.pop("shared", {})
        if "trajectories" in ancestor:
            ancestor["trajectories"] = ancestry.checked_rows(values[ancestor["trajectories"]])
        most_characters -= sum(sizes[at] for at in shared.values())
        if most_characters < 0:
            raise ValueError("too long")
        if shared:
            ancestor["parameters"] = {**ancestor["parameters"], **{name: values[at] for name, at in shared.items()}}
    return header


def recompute_id(header: Header) -> str:
    """Recompute the id from a header, to detect edits; empty if the header lacks parts of the id."""
    keys = ("kind", "method", "parameters", "seed", "content", "simulated", "parents")
    try:
        identity = {key: header[key] for key in keys} | {"major": int(header["version"].split(".")[0])}
        text = canonical(identity)
    except (KeyError, AttributeError, ValueError, TypeError, RecursionError):
        return ""
    return hashlib.sha256(text.encode()).hexdigest()


def history_fault(header: Header) -> str:
    """Return what is wrong with the ids of a header's ancestors; empty if all are right."""
    for id_, ancestor in header["history"].items():
        if not isinstance(ancestor, dict) or ancestor.get("id") != id_ or recompute_id(ancestor) != id_:
            return f"the history of {id_[:12]} was edited"
    every = header["history"].keys() | header.get("ancestors", {}).keys()
    missing = [str(parent)[:12] for parent in header["parents"] if parent not in every]
    recordings = {row["recording"] for row in header.get("trajectories", ())} - {None}
    missing += [id_[:12] for id_ in sorted(recordings - every)]
    return f"the history lacks {', '.join(missing[:8])}" if missing else ""


def time_host_versions() -> dict[str, str]:
    """Return time, host and versions, also of plug-ins, which are stored but not part of the id."""
    return {
        **plugins.used(),  # first, so that no package replaces an entry below
        "at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "host": platform.node(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "evetac": __version__,
        **_libraries(),
    }


@cache
def _libraries() -> dict[str, str]:
    """Return the versions of the libraries on which arrays depend; looking them up takes 15 ms."""
    from importlib import metadata  # imported here, since reading a file does not need it

    versions = {}
    for name in ("numpy", "numba", "h5py", "scipy", "torch", "opencv-contrib-python-headless", "onnxruntime"):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def first_difference(wanted: Recipe, existing: Header) -> str:
    """Return a description of the first difference between an existing recipe and the wanted one."""
    for key in ("kind", "method", "seed", "content", "parameters"):
        if difference := _difference(wanted.identity[key], existing[key], key):
            return difference
    if len(existing["parents"]) != len(wanted.parents):
        return f"it was made from {len(existing['parents'])} files, now from {len(wanted.parents)}"
    for parent, theirs in zip(wanted.parents, existing["parents"], strict=True):
        if parent["id"] != theirs:
            return f"its {parent['kind']} was {_short(theirs)}, now {parent['id'][:12]}"
    return "the schema version differs"


def other_recipe(path: str, difference: str) -> InputError:
    """Return the error for an existing output that was made with another recipe, with the first difference."""
    return InputError(
        "the output exists and was made with another recipe",
        where=path,
        found=difference,
        hint="--force replaces it, -o NAME writes to another file",
    )


def _difference(ours: Any, theirs: Any, where: str) -> str:
    """Return the first difference between two nested parameter values; empty if they are equal."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in sorted(ours.keys() | theirs.keys()):
            if key not in theirs or key not in ours:
                side = "requested, but not in the file" if key in ours else "in the file, but not requested"
                return f"{where}.{key} is {side}"
            if inner := _difference(ours[key], theirs[key], f"{where}.{key}"):
                return inner
        return ""
    same = canonical(ours) == canonical(theirs)
    return "" if same else f"{where} is {_short(theirs)} in the file, {_short(ours)} requested"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


class ContentDigest:
    """SHA-256 over named arrays, with dtype and shape, which arrive in blocks of any size."""

    def __init__(self) -> None:
        self._hashes: dict[str, Any] = {}

    def update(self, path: str, value: Any) -> None:
        """Add the next block of one array (or a whole scalar or str)."""
        if isinstance(value, str):
            what, content = "utf8", np.frombuffer(value.encode(), np.uint8)
        else:
            array = np.asarray(value)
            row = array.shape[1:] if array.ndim else "scalar"  # the number of rows follows from the bytes
            what, content = f"{array.dtype.str} {row}", np.ascontiguousarray(array).view(np.uint8)
        if path not in self._hashes:
            self._hashes[path] = hashlib.sha256(what.encode())
        self._hashes[path].update(content)

    def update_all(self, arrays: Mapping[str, Any]) -> None:
        """Add the next blocks of some arrays."""
        for path, value in arrays.items():
            self.update(path, value)

    def hexdigest(self) -> str:
        """Return the digest over all paths, in sorted order."""
        return hashlib.sha256(
            canonical({path: hash_.hexdigest() for path, hash_ in self._hashes.items()}).encode()
        ).hexdigest()


def content_digest(arrays: Mapping[str, Any]) -> str:
    """Return the digest of whole arrays, which does not depend on compression or order in a file."""
    digest = ContentDigest()
    digest.update_all(arrays)
    return digest.hexdigest()


FOREIGN = "event files of other programs are read with `evetac record --from FILE`"

# The keys of every header, except `history`, and their types.
HEADER: dict[str, tuple[type, ...]] = {
    "kind": (str,),
    "version": (str,),
    "method": (int,),
    "parameters": (dict,),
    "seed": (int, NoneType),
    "parents": (list,),
    "content": (str, NoneType),
    "id": (str,),
    "simulated": (bool,),
}


def read_header(file: CheckedHdf5) -> Header:
    """Return the header of an open file; ForeignFile if there is none, InputError for another version."""
    path, text = file.path, file.text_attribute("header")
    if text is None:
        raise ForeignFile("this HDF5 file was not made by evetac: it has no header", where=str(path), hint=FOREIGN)
    try:
        header = unfolded(dict(parse_json(text, whole_bits=SEED_BITS)), MOST_TEXT_BYTES)
    except (AttributeError, LookupError, ValueError, TypeError, RecursionError):
        raise SchemaError("its header is not valid", where=str(path), expected="schemas/header.v1.json") from None
    version = re.fullmatch("([0-9]{1,9})[.]([0-9]{1,9})", str(header.get("version")))
    number = (int(version[1]), int(version[2])) if version else None
    if number and number[0] > schema.MAJOR:  # checked first: such a header may have another form
        raise InputError("made by a newer evetac", where=str(path), found=f"version {header['version']}")
    wrong = _wrong(header) + ([] if number else ["version"])
    if not isinstance(header.get("history"), dict) or any(
        not isinstance(ancestor, dict) or _wrong(ancestor) for ancestor in header["history"].values()
    ):
        wrong.append("history")
    if wrong:
        message = f"its header is not valid: {', '.join(dict.fromkeys(wrong))}"
        raise SchemaError(message, where=str(path), expected="schemas/header.v1.json")
    return header


def _wrong(header: Header) -> list[str]:
    """Return the keys of a header, or of an ancestor's, which has no history, whose values are missing or not valid."""
    wrong = [key for key, types in HEADER.items() if not isinstance(header.get(key, ...), types)]
    return wrong or ([] if all(isinstance(parent, str) for parent in header["parents"]) else ["parents"])


def check_kind(path: Path, header: Header, wanted: tuple[str, ...] | None) -> None:
    """Raise InputError if a header is not of the expected kind, or of an unknown kind."""
    if wanted and header["kind"] not in wanted:
        expected, hint = " or ".join(wanted), "; ".join(map(made_by, wanted))
        raise InputError("wrong kind of file", where=str(path), expected=expected, found=header["kind"], hint=hint)
    if header["kind"] not in schema.KINDS:
        raise SchemaError("unknown kind", where=str(path), expected=", ".join(schema.KINDS), found=str(header["kind"]))
