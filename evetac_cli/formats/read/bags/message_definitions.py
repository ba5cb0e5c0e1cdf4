"""Compute the checksum of a ROS message definition, which identifies a layout independently of its package's name.

ROS 1 writes this checksum into its bags. Here rosbags also computes it from the text of a definition, including those
of ROS 2, so that one table of checksums identifies a layout in every bag. Times and headers, which ROS 2 writes
differently, count as in ROS 1. A text is only parsed: nothing is registered, which would turn it into code.
"""

MOST_BYTES = 1 << 16  # of a text; those of ROS have a few thousand
OF_ROS1 = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


def checksum(kind: str, text: str) -> str:
    """Return the checksum of a message type; empty if the text is not a definition or lacks an inner message."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not text.strip() or len(text) > MOST_BYTES:
        return ""
    name, store, ros1 = full_name(kind), get_typestore(Stores.EMPTY), get_typestore(Stores.ROS1_NOETIC)
    try:
        store.fielddefs.update(get_types_from_msg(text.replace("\r", ""), name))
        store.fielddefs.update({of_ros1: ros1.fielddefs[of_ros1] for of_ros1 in OF_ROS1})
        return store.generate_msgdef(name)[1]
    except Exception:  # rosbags raises all kinds for texts that are no definitions
        return ""


def full_name(kind: str) -> str:
    """Return a type as `package/msg/Name`; ROS 1 leaves out `msg`."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else kind
