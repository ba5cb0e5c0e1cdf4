"""Write the events that come on stdin into an AEDAT4 file with dv-processing. Run as a script.

    write_aedat4_child.py FILE WIDTH HEIGHT NOTE

Input: for every piece its number of events (int64), then as many records of EVENT; 0 events mark the end. Exit codes,
with a line on stderr: 3 if dv-processing refuses, 4 if it does not load.
"""

import os
import resource
import sys

import numpy as np

EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "?")])
PACKET_EVENTS = 8192  # some 10 ms of a busy sensor, as recorders cut them
REFUSED = 3
NOT_INSTALLED = 4
CAMERA = "evetac"


def main(file: str, width: int, height: int, note: str) -> int:
    """Write all events; returns the exit code."""
    source = os.fdopen(os.dup(0), "rb")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        import dv_processing as dv

        config = dv.io.MonoCameraWriter.Config(CAMERA)
        config.addEventStream((width, height))
        config.addStreamMetadata("events", ("evetac", note))
        writer = dv.io.MonoCameraWriter(file, config)
        while count := int.from_bytes(source.read(8), "little"):
            data = source.read(count * EVENT.itemsize)
            if len(data) < count * EVENT.itemsize:
                raise RuntimeError("the events ended too early")
            rows = np.frombuffer(data, EVENT)
            for first in range(0, count, PACKET_EVENTS):
                packet = dv.EventStore()  # takes events one by one only
                for row in rows[first : first + PACKET_EVENTS].tolist():
                    packet.push_back(*row)
                writer.writeEventPacket(packet.toPacket())
        del writer  # closes the file
    except Exception as error:  # C++ exceptions arrive as all kinds of types, with a stack trace inside
        text = str(error).split("Stacktrace:")[0].strip().split("\n")
        print(text[-1] or type(error).__name__, file=sys.stderr)
        return NOT_INSTALLED if isinstance(error, ImportError) else REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]))
