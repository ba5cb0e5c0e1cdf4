"""Decode one event stream of an AEDAT4 file with dv-processing, and write raw events to stdout. Run as a script.

Why so: on a damaged packet dv-processing 2.0.4 can spin for ever, inside C++ and holding Python's lock, so that nothing
in the same process can stop it. As a process of its own it can be ended: it gives itself a limit of CPU time for every
packet, and the kernel keeps it to that.

    read_aedat4_child.py FILE CAMERA STREAM SECONDS

Output: for every packet its number of events (int64), then as many records of EVENT; -1 events mark the end.
CAMERA may be empty. Exit codes, with one line on stderr: 3 if dv-processing refuses the file, 4 if it does not load.
"""

import os
import resource
import struct
import sys
import time

import numpy as np

EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "i1")])
REFUSED = 3
NOT_INSTALLED = 4


def main(file: str, camera: str, stream: str, seconds: int) -> int:
    """Write all events of the stream; returns the exit code."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever the library prints must not get between the events
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        import dv_processing as dv

        _allow(seconds)
        recording = dv.io.MonoCameraRecording(file, camera) if camera else dv.io.MonoCameraRecording(file)
        while True:
            _allow(seconds)
            packet = recording.getNextEventBatch(stream)
            if packet is None:
                break
            found = packet.numpy()
            events = np.empty(len(found), EVENT)
            for ours, theirs in zip("txyp", ("timestamp", "x", "y", "polarity"), strict=True):
                events[ours] = found[theirs]
            out.write(struct.pack("<q", len(events)) + events.tobytes())
            out.flush()
    except Exception as error:  # C++ exceptions arrive as all kinds of types, with a stack trace inside
        text = str(error).split("Stacktrace:")[0].split("\n")
        print(([line.strip() for line in text if line.strip()] or [type(error).__name__])[-1], file=sys.stderr)
        return NOT_INSTALLED if isinstance(error, ImportError) else REFUSED
    out.write(struct.pack("<q", -1))
    out.close()
    return 0


def _allow(seconds: int) -> None:
    """Let the kernel end this process (SIGXCPU) if it uses more than that many seconds of CPU time from now on."""
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    soft = int(time.process_time()) + 2 + seconds  # the limit is in whole seconds: 1 to 2 more than asked for
    resource.setrlimit(resource.RLIMIT_CPU, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])))
