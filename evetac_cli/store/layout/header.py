"""Reads and checks the header of a stage file: its validity, kind and version."""

import re
from pathlib import Path
from types import NoneType

from evetac_cli.errors import ForeignFile, InputError, SchemaError, made_by
from evetac_cli.store.hdf5.checked_hdf5 import CheckedHdf5
from evetac_cli.store.hdf5.hdf5_text import MOST_TEXT_BYTES
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Header, canonical, unfolded
from evetac_cli.text_files import SEED_BITS, parse_json

FOREIGN = "event files of other programs are read with `evetac record --from FILE`"

# The keys of every header, and their types.
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
    "history": (dict,),
}


def read_header(file: CheckedHdf5) -> Header:
    """Return the header of an open file; ForeignFile if there is none, InputError for another version."""
    path, text = file.path, file.text_attribute("header")
    if text is None:
        raise ForeignFile("this HDF5 file was not made by evetac: it has no header", where=str(path), hint=FOREIGN)
    try:
        header = dict(parse_json(text, whole_bits=SEED_BITS))
        canonical(header)
        header = unfolded(header, MOST_TEXT_BYTES)
    except (AttributeError, KeyError, ValueError, TypeError, RecursionError):
        raise SchemaError("its header is not valid", where=str(path), expected="schemas/header.v1.json") from None
    number = header.get("version")
    version = re.fullmatch("([0-9]{1,9})[.]([0-9]{1,9})", number) if isinstance(number, str) else None
    if version and (int(version[1]), int(version[2])) < (schema.MAJOR, schema.OLDEST_MINOR):
        raise InputError(
            "written by an earlier version of evetac and cannot be read",
            where=str(path),
            expected=f"version {schema.MAJOR}.{schema.OLDEST_MINOR} or newer",
            found=f"{header.get('kind')} version {version[0]}",
            hint="make it again from its recipe: names of datasets and parameters have changed",
        )
    if version and int(version[1]) > schema.MAJOR:  # checked first: such a header may have another form
        raise InputError(
            f"made by a newer evetac: {header.get('kind')} version {version[0]}",
            where=str(path),
            expected=f"version {schema.MAJOR}.x",
            hint="update evetac",
        )
    missing = [key for key in HEADER if key not in header]
    if missing:
        raise SchemaError("its header is incomplete", where=str(path), found=f"no {', '.join(missing)}")
    wrong = _wrong(header) + ([] if isinstance(header["history"], dict) else ["history"])
    wrong += [] if version or "version" in wrong else ["version"]
    if not wrong:
        whole = all(isinstance(ancestor, dict) and not _wrong(ancestor) for ancestor in header["history"].values())
        wrong += [] if whole else ["history"]
    if wrong:
        raise SchemaError(
            f"its header is not valid: {', '.join(wrong)}", where=str(path), expected="schemas/header.v1.json"
        )
    return header


def _wrong(header: Header) -> list[str]:
    """Return the keys of a header, or of an ancestor's, which has no history, whose values are missing or not valid."""
    wrong = [key for key, types in HEADER.items() if key != "history" and not isinstance(header.get(key, ...), types)]
    return wrong or ([] if all(isinstance(parent, str) for parent in header["parents"]) else ["parents"])


def check_kind(path: Path, header: Header, wanted: tuple[str, ...] | None) -> None:
    """Raise InputError if a header is not of the expected kind, or of an unknown kind."""
    if wanted and header["kind"] not in wanted:
        raise InputError(
            "wrong kind of file",
            where=str(path),
            expected=" or ".join(wanted),
            found=str(header["kind"]),
            hint="; ".join(map(made_by, wanted)),
        )
    if header["kind"] not in schema.KINDS:
        raise SchemaError("unknown kind", where=str(path), expected=", ".join(schema.KINDS), found=str(header["kind"]))
