"""The command `evetac`, and `python -m evetac_cli`.

Loading the commands takes half a second, in which Ctrl-C would end in a traceback. So signals are looked after first.
"""

import os
import signal
import sys
from types import FrameType
from typing import NoReturn


def main() -> None:
    """Load the commands and run the one that was asked for."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        from evetac_cli.cli.main import main as run
    except KeyboardInterrupt:
        _end()
    run()


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _end() -> NoReturn:
    """Nothing was begun: say so, and leave at once."""
    from evetac_cli import console

    error = KeyboardInterrupt("interrupted: nothing was begun")
    console.say(str(error))
    if "--json" in sys.argv:
        console.show_failure("", [error], [])
        sys.stdout.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
