"""The identity of a result: what made it (recipe), the hash of that (recipe id), and the header that says so in a file.

Two files with the same id hold the same numbers on the same machine type, so a stage whose output already carries the
id of the wanted recipe has nothing to do. The id covers the kind, its major version (minor ones only add), the method
number of the stage, every parameter, the seed and the parents' ids. A recording from a device or a file cannot be made
again from a recipe: the hash of its stored arrays stands in for the seed. Time, host and versions of libraries
are recorded beside it and are not part of it.
"""

import hashlib
import json
import platform
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from evetac_cli import __version__, plugins
from evetac_cli.errors import InputError
from evetac_cli.store.layout import schema

Header = dict[str, Any]

LEAST_SHARED = 64  # characters: its place in the list takes some 20


def canonical(value: Any) -> str:
    """JSON with sorted keys and no blanks; NaN and infinity are refused."""
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
        """The parts that make a result what it is, as JSON values; the id is their hash."""
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
        """The header of a file made now from this recipe; carries the whole history of its parents, each once.

        But a recording does not carry what the detector of its grasp learned from, which the model's own file tells:
        thousands of ancestors, some megabytes of each grasp.
        """
        history: dict[str, Header] = {}
        for parent in self._carried_parents():
            history.update(parent["history"])
            history[parent["id"]] = {k: v for k, v in parent.items() if k not in ("history", "made")}
        return {
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
            "made": made(),
        }

    def carried(self) -> "Recipe":
        """The recipe without what its header does not carry: they have the same header."""
        return replace(self, parents=self._carried_parents())

    def _carried_parents(self) -> tuple[Header, ...]:
        if self.kind != "recording":
            return self.parents
        return tuple({**each, "history": {}} if each["kind"] == "model" else each for each in self.parents)


def folded(header: Header) -> Header:
    """The header as it lies in a file: what several ancestors have as a parameter stands once, in its list `shared`.

    Such an ancestor has, beside its own `parameters`, `shared`: name of a parameter -> place in that list. Why so: a
    model has hundreds of recordings of few scenes, whose parameters are most of its header.
    """
    ancestors = header["history"].values()
    counts = Counter(canonical(value) for ancestor in ancestors for value in ancestor["parameters"].values())
    texts = {text for text, count in counts.items() if count > 1 and len(text) >= LEAST_SHARED}
    places: dict[str, int] = {}
    history = {}
    for id_, ancestor in sorted(header["history"].items()):
        known = {name: canonical(value) for name, value in ancestor["parameters"].items()}
        shared = {name: places.setdefault(text, len(places)) for name, text in known.items() if text in texts}
        own = {name: value for name, value in ancestor["parameters"].items() if name not in shared}
        history[id_] = {**ancestor, "parameters": own, "shared": shared} if shared else ancestor
    return {**header, "history": history, "shared": [json.loads(text) for text in places]} if places else header


def unfolded(header: Header, most_characters: int) -> Header:
    """The whole header of one that lies in a file; ValueError where `shared` does not fit, or makes more than so much.

    Ancestors have parameters that they share in common, not as copies.
    """
    values = header.pop("shared", [])
    if not isinstance(values, list):
        raise ValueError("expected a list of what is shared")
    sizes = [len(canonical(value)) for value in values]
    history = header.get("history")
    for ancestor in history.values() if isinstance(history, dict) else ():
        shared = ancestor.pop("shared", {}) if isinstance(ancestor, dict) else {}
        if not isinstance(shared, dict) or not all(type(at) is int and 0 <= at < len(sizes) for at in shared.values()):
            raise ValueError("an ancestor shares what is not there")
        most_characters -= sum(sizes[at] for at in shared.values())
        if most_characters < 0:
            raise ValueError("too long")
        if shared:
            ancestor["parameters"] = {**ancestor["parameters"], **{name: values[at] for name, at in shared.items()}}
    return header


def recompute_id(header: Header) -> str:
    """Recompute the id from a header, to see whether somebody edited it; empty if it lacks what an id is made of."""
    keys = ("kind", "method", "parameters", "seed", "content", "simulated", "parents")
    try:
        identity = {key: header[key] for key in keys} | {"major": int(header["version"].split(".")[0])}
        text = canonical(identity)
    except (KeyError, AttributeError, ValueError, TypeError, RecursionError):
        return ""
    return hashlib.sha256(text.encode()).hexdigest()


def identity_fault(header: Header) -> str:
    """What does not fit in the ids of a header and of its ancestors, in words; empty if all do."""
    if recompute_id(header) != header["id"]:
        return "its header was edited: the recipe id does not fit it"
    for id_, ancestor in header["history"].items():
        if not isinstance(ancestor, dict) or ancestor.get("id") != id_ or recompute_id(ancestor) != id_:
            return f"the history of {id_[:12]} was edited"
    missing = [str(parent)[:12] for parent in header["parents"] if parent not in header["history"]]
    return f"the history lacks the parents {', '.join(missing)}" if missing else ""


def made() -> dict[str, str]:
    """Time, host and versions, of plug-ins too: recorded, not part of the id."""
    return {
        **plugins.used(),  # first, so that no package stands in the place of what follows
        "at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "host": platform.node(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "evetac": __version__,
        **_libraries(),
    }


@cache
def _libraries() -> dict[str, str]:
    """Versions of the libraries that arrays depend on; looking them up takes 15 ms."""
    from importlib import metadata  # here, as whoever reads a file makes none

    versions = {}
    for name in ("numpy", "numba", "h5py", "scipy", "torch", "opencv-contrib-python-headless", "onnxruntime"):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def first_difference(wanted: Recipe, existing: Header) -> str:
    """Say in words where another recipe departs from the wanted one."""
    for key in ("kind", "method", "seed", "content"):
        ours = wanted.identity[key]
        if ours != existing[key]:
            return f"{key} is {_short(existing[key])} in the file, {_short(ours)} wanted"
    difference = _difference(wanted.parameters, existing["parameters"], "parameters")
    if difference:
        return difference
    if len(existing["parents"]) != len(wanted.parents):
        return f"it was made from {len(existing['parents'])} files, now {len(wanted.parents)}"
    for parent, theirs in zip(wanted.parents, existing["parents"], strict=True):
        if parent["id"] != theirs:
            return f"its {parent['kind']} was {_short(theirs)}, now {parent['id'][:12]}"
    return "the schema version differs"


def other_recipe(path: str, difference: str) -> InputError:
    """The error for an output that exists and that another recipe made, with the first difference of the two."""
    return InputError(
        "the output exists and was made by another recipe",
        where=path,
        found=difference,
        hint="--force replaces it, -o NAME writes elsewhere",
    )


def _difference(ours: Any, theirs: Any, where: str) -> str:
    """First place where two nested parameter values differ, or an empty string."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in sorted(ours.keys() | theirs.keys()):
            if key not in theirs or key not in ours:
                side = "wanted, but not in the file" if key in ours else "in the file, but not wanted"
                return f"{where}.{key} is {side}"
            inner = _difference(ours[key], theirs[key], f"{where}.{key}")
            if inner:
                return inner
        return ""
    return (
        ""
        if canonical(ours) == canonical(theirs)
        else f"{where} is {_short(theirs)} in the file, {_short(ours)} wanted"
    )


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


class ContentDigest:
    """SHA-256 over named arrays, with dtype and shape, that arrive in pieces; independent of how they were cut."""

    def __init__(self) -> None:
        self._hashes: dict[str, Any] = {}

    def update(self, path: str, value: Any) -> None:
        """Add the next piece of one array (or the whole of a scalar or a str)."""
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
        """Add the next pieces of some arrays."""
        for path, value in arrays.items():
            self.update(path, value)

    def hexdigest(self) -> str:
        """The digest over all paths, in their sorted order."""
        return hashlib.sha256(
            canonical({path: hash_.hexdigest() for path, hash_ in self._hashes.items()}).encode()
        ).hexdigest()


def content_digest(arrays: Mapping[str, Any]) -> str:
    """Digest of whole arrays; equal for equal content, whatever the compression or order in a file."""
    digest = ContentDigest()
    digest.update_all(arrays)
    return digest.hexdigest()
