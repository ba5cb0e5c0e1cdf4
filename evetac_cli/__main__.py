"""The command `evetac`, and `python -m evetac_cli`.

Loading the commands takes half a second, during which Ctrl-C would print a traceback. So signals are handled first.
"""

import gc
import os
import signal
import sys
from typing import NoReturn

from evetac_cli import interrupts

# Number of new objects after which Python collects garbage. With the default of 700 it would collect a hundred times
# while modules are loaded, without freeing anything: a seventh of a command's time.
GARBAGE_AFTER = 10_000


def main() -> None:
    """Load the commands and run the requested one."""
    gc.set_threshold(GARBAGE_AFTER)
    try:
        interrupts.catch_interrupts()
        # The program that started this one may have blocked the signal.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        from evetac_cli.cli.main import main as run

        if interrupts.interrupt_received():  # an import may swallow what a signal raises
            _end()
    except KeyboardInterrupt:
        _end()
    run()


def _end() -> NoReturn:
    """Report that the command was interrupted before it started, and exit."""
    from evetac_cli import console

    error = KeyboardInterrupt("interrupted before the command started")
    console.say(str(error))
    if "--json" in sys.argv:
        console.show_failure("", [error], [])
        sys.stdout.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
