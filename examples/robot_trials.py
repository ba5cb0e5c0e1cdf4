"""A robot program that records its trials with evetac. It needs only Python's standard library.

evetac record --camera dvxplorer --gripper none --listen --out data      # in another terminal
python examples/robot_trials.py data 3
"""

import json
import os
import socket
import sys
import time
from pathlib import Path


class Recorder:
    """A connection to the evetac process that listens in a folder."""

    def __init__(self, folder: str) -> None:
        file = Path(folder, "evetac.listen")
        if file.stat().st_uid != os.getuid():
            raise PermissionError(f"{file} belongs to another user")
        address, port, self._token = file.read_text().split()
        self._lines = socket.create_connection((address, int(port))).makefile("rw")

    def ask(self, command: str, **fields: object) -> dict:
        """Send start, mark, stop, status or abort; return the answer, or raise RuntimeError with the reason."""
        print(json.dumps({"token": self._token, "command": command, **fields}), file=self._lines, flush=True)
        line = self._lines.readline()
        answer = json.loads(line) if line else {"ok": False, "error": "evetac has ended"}
        if not answer["ok"]:
            raise RuntimeError(f"{command}: {answer['error']}")
        return answer


def main() -> None:
    """Record a few trials."""
    recorder = Recorder(sys.argv[1])
    for number in range(int(sys.argv[2])):
        recorder.ask("start", name=f"trial-{time.strftime('%Y%m%d-%H%M%S')}-{number:03d}")  # evetac records from here
        time.sleep(0.3)  # move the arm here
        recorder.ask("mark", text="touched", at_s=time.monotonic())
        time.sleep(0.3)
        print(recorder.ask("stop")["file"])


if __name__ == "__main__":
    main()
