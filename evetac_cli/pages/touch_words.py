"""Words for the knowledge of a gel's stiffness, which scales all forces of a touch file."""

from collections.abc import Mapping
from typing import Any

ADAPTED, KNOWN, UNKNOWN = "adapted with known forces", "known", "not known"
MODULUS = "shear_modulus_pa"


def stiffness(header: Mapping[str, Any]) -> str:
    """Return ADAPTED, KNOWN or UNKNOWN, by the header of a touch file, which may contain anything."""
    if any(_inner(ancestor, "kind") == "force-model" for ancestor in header["history"].values()):
        return ADAPTED  # the only kind of model used for touch maps
    return UNKNOWN if _inner(header, "parameters", "known", MODULUS) is None else KNOWN


def stiffness_in_figures(header: Mapping[str, Any]) -> str:
    """Return the same, with the modulus and its relative error if the header has them."""
    which = stiffness(header)
    if which != KNOWN:
        return which
    modulus_pa = _inner(header, "parameters", "known", MODULUS)
    error = _inner(header, "parameters", "stiffness_error")
    if not _is_number(modulus_pa):
        return which
    within = f" within {100 * error:.3g} %" if _is_number(error) else ""
    return f"known, {modulus_pa / 1e3:.4g} kPa{within}"


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _inner(table: Any, *names: str) -> Any:
    """Return a value inside nested tables; None if there is none."""
    for name in names:
        table = table.get(name) if isinstance(table, Mapping) else None
    return table
