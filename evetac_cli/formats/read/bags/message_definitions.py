"""Compute the checksum of a ROS message definition, which identifies a layout independently of its package's name.

ROS 1 writes this checksum into its bags. Here it is also computed from the text of a definition, including those of
ROS 2, so that one table of checksums identifies a layout in every bag. It is the MD5 of constants and fields, without
comments, and with the checksum of an inner message in place of its name. Times and headers, which ROS 2 writes
differently, count as in ROS 1. A text is only parsed, never executed. Source:
http://wiki.ros.org/ROS/Technical%20Overview
"""

import re
from hashlib import md5

MOST_DEPTH = 16  # of nested messages; those of ROS have four levels
MOST_BYTES = 1 << 20
PLAIN = ("bool", "byte", "char", "float32", "float64", "string", "wstring", "time", "duration") + tuple(
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
)
# Types that have another name in ROS 2, with the ROS 1 type that they count as.
SAME = {"builtin_interfaces/Time": "time", "builtin_interfaces/Duration": "duration"}
HEADER = "2176decaecbce78abc3b96ef049fabed"  # ROS 1 checksum of std_msgs/Header; in ROS 2 it has no sequence number
BETWEEN = re.compile(r"^=+[ \t]*$", re.MULTILINE)  # separates the parts of a text
CONSTANT = re.compile(r"(\S+)\s+([A-Za-z]\w*)\s*=(.*)")


def checksum(kind: str, text: str) -> str:
    """Return the checksum of a message type; empty if the text is not a definition or lacks an inner message."""
    if not text.strip() or len(text) > MOST_BYTES:
        return ""
    first, *others = BETWEEN.split(text)
    parts = {_short(kind): first}
    for other in others:
        head, _, body = other.strip().partition("\n")
        if head.startswith("MSG:"):
            parts.setdefault(_short(head.removeprefix("MSG:").strip()), body)
    try:
        return _checksum(_short(kind), parts, MOST_DEPTH)
    except (KeyError, ValueError):
        return ""


def full_name(kind: str) -> str:
    """Return a type as `package/msg/Name`; ROS 1 leaves out `msg`."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else kind


def _short(kind: str) -> str:
    return kind.replace("/msg/", "/")


def _checksum(kind: str, parts: dict[str, str], depth: int) -> str:
    """Return the checksum; raise KeyError if a message is not defined, ValueError for a line that is not a field."""
    if kind == "std_msgs/Header":
        return HEADER
    if not depth:
        raise ValueError("messages are nested too deeply")
    package = kind.partition("/")[0]
    constants, fields = [], []
    for line in parts[kind].splitlines():
        if constant := CONSTANT.fullmatch(line.strip()):
            type_, name, value = constant.groups()
            value = value if type_ == "string" else value.partition("#")[0]
            constants.append(f"{type_} {name}={value.strip()}")
            continue
        words = line.partition("#")[0].split()
        if not words:
            continue
        type_, name = words[:2]  # a default of ROS 2 may follow
        plain, bracket, _ = type_.partition("[")
        plain = SAME.get(_short(plain), plain)
        if plain.partition("<")[0] in PLAIN:
            fields.append(f"{plain}{type_[type_.index('[') :] if bracket else ''} {name}")
            continue
        inner = "std_msgs/Header" if plain == "Header" else _short(plain)
        inner = inner if "/" in inner else f"{package}/{inner}"
        fields.append(f"{_checksum(inner, parts, depth - 1)} {name}")
    return md5("\n".join(constants + fields).encode(), usedforsecurity=False).hexdigest()
