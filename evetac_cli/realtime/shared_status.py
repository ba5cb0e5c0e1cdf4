"""What detector and controller of a grasp in real time share: a few numbers, told by one and looked at by the other.

The detector counts slices with slip at 1000 Hz, the controller looks every 2 ms. Beside what is felt stands when it was
told and what it was told of, so that the controller can tell a detector that died, a camera that is silent, and how old
the news is.
"""

import multiprocessing
from typing import NamedTuple

from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.shared_row import SharedRow

REMEMBERED = 32  # slices with slip whose time is known
_SIZE = 1024
_STOP_AT = 768


class DetectorStatus(NamedTuple):
    """A sign of life of the detector; times in us of time.monotonic."""

    felt: SlipSignal
    slices: int  # that the detector has felt
    at_us: float  # when it told this
    heard_us: float  # when the camera last gave an event
    zero_us: float  # when the recording's time was 0
    slip_us: tuple[float, ...]  # first events of the latest slices with slip, oldest first; up to REMEMBERED

    def slip_began_us(self, seen: int) -> float:
        """First event of the earliest slice with slip after the first `seen` ones, as far as remembered.

        NaN if there was none since.
        """
        new = min(self.felt.slips - seen, len(self.slip_us))
        return self.slip_us[-new] if new > 0 else float("nan")


class SharedStatus:
    """The shared memory; may be given to a process that is being spawned."""

    def __init__(self) -> None:
        self._block = multiprocessing.get_context("spawn").RawArray("B", _SIZE)
        self._attach()

    def _attach(self) -> None:
        memory = memoryview(self._block).cast("B")
        self._sign = SharedRow(memory, 0, f"q3dq3d{REMEMBERED}d")
        self._stop = SharedRow(memory, _STOP_AT, "q")

    def __getstate__(self) -> dict[str, object]:
        return {"_block": self._block}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._attach()

    def publish(self, sign: DetectorStatus) -> None:
        """For the detector."""
        known = sign.slip_us[-REMEMBERED:]
        unknown = (float("nan"),) * (REMEMBERED - len(known))
        self._sign.write(*sign.felt, *sign[1:5], *unknown, *known)

    def latest(self) -> DetectorStatus | None:
        """For the controller: the latest sign; None before the first."""
        found = self._sign.read()
        if found is None:
            return None
        slips, *felt, slices, at_us, heard_us, zero_us = found[1][:8]
        known = min(int(slips), REMEMBERED)
        slip_us = found[1][8 + REMEMBERED - known :]
        return DetectorStatus(SlipSignal(int(slips), *felt), int(slices), at_us, heard_us, zero_us, slip_us)

    def stop(self) -> None:
        """For whoever started both: end, as soon as possible."""
        self._stop.write(1)

    @property
    def stopping(self) -> bool:
        """Whether it was told to end."""
        return self._stop.read() is not None
