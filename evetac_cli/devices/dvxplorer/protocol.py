"""The USB requests of a DVXplorer Mini as data: requests, modules, parameters, and the orders that start and stop it.

The Mini exists in two protocol generations with the same USB id. Firmware 10 (PARAMETERS) takes 8-byte values of some
25 parameters. Firmware 9 and earlier (REGISTERS) takes 4-byte values for the sensor's own registers. Event words are
the same. Order and values were measured from the maker's drivers (dv-processing 2.0.4 and 1.7.9); the registers for
readout rates and thresholds are those of libcaer and jAER. Nothing here stores to flash: request 0xC7 is not even
defined.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from evetac_cli.errors import check_range, check_whole
from evetac_cli.events import FRAME_PX

VENDOR, PRODUCT = 0x152A, 0x8419  # shared by all DVXplorer models
MINI_BOARD = 4  # bcdDevice >> 8 on the CX3 boards: Mini and Micro
NEWEST_FIRMWARE = 10
DATA_ENDPOINT, DEBUG_ENDPOINT = 0x82, 0x81
WRITE, READ = 0x40, 0xC0  # bmRequestType of vendor requests
CONFIG, LOG_LEVEL, FLUSH_STALE = 0xBF, 0xB1, 0xC6  # bRequest
LOG_PACKET = 0x00  # first byte of a log packet on the debug endpoint

DVS, IMU, SENSOR, SYSTEM = 1, 3, 5, 6  # modules
COLUMNS, ROWS, ORIENTATION, RUN = 0, 1, 2, 3  # parameters of DVS
FLATTEN, CROP, APPLY_CROP, FLIP_X, FLIP_Y = 4, 19, 23, 24, 25
MIPI_TIMEOUT_ON, MIPI_TIMEOUT_US, READOUT, THRESHOLD_ON, THRESHOLD_OFF = 11, 12, 13, 14, 15
SENSOR_MODE, STREAM = 0x3000, 2  # the register that starts the stream in generation REGISTERS
CLOCK_MHZ = 50

LAST_THRESHOLD = 17  # the least sensitive threshold; 0 is the most sensitive
# Name of a readout rate: registers of firmware 9: (fixed, read time us, hold ms, hold us, next column, most events).
READOUT_RATES = {
    "constant-100": (1, 900, 9, 100, 15, 10),
    "constant-200": (1, 900, 4, 100, 15, 10),
    "constant-500": (1, 900, 1, 100, 15, 10),
    "constant-1000": (1, 900, 0, 100, 15, 10),
    "lossy-2000": (1, 499, 0, 1, 5, 0),
    "lossy-5000": (1, 199, 0, 1, 5, 0),
    "lossy-10000": (1, 99, 0, 1, 5, 0),
    "variable-2000": (0, 900, 0, 307, 15, 10),
    "variable-5000": (0, 900, 0, 7, 15, 10),
    "variable-10000": (0, 900, 0, 10, 7, 2),
    "variable-15000": (0, 900, 0, 1, 5, 0),
}


class Generation(Enum):
    """Protocol generation; the value is the number of bytes per register value."""

    REGISTERS = 4
    PARAMETERS = 8


def generation(firmware: int) -> Generation:
    """Return the generation of a firmware (bcdDevice & 0xFF)."""
    return Generation.PARAMETERS if firmware >= NEWEST_FIRMWARE else Generation.REGISTERS


@dataclass(frozen=True)
class DvxplorerSettings:
    """Settings of the camera; ValueError if out of range."""

    threshold_on: int = 9  # contrast threshold, 0..17
    threshold_off: int = 9
    readout_rate: str = "variable-5000"  # frames per second (READOUT_RATES); all events of a frame share one time
    flush_us: int = 1000  # a quiet sensor's words leave the camera at least this often (firmware 10)
    global_hold: bool = True  # pixels are frozen while a frame is read

    def __post_init__(self) -> None:
        for name in ("threshold_on", "threshold_off"):
            check_whole(name, getattr(self, name), 0, LAST_THRESHOLD)
        if self.readout_rate not in READOUT_RATES:
            raise ValueError(f"readout_rate: expected one of {', '.join(READOUT_RATES)}, found {self.readout_rate}")
        check_range("flush_us", self.flush_us, 1, 100_000)


class Write(NamedTuple):
    """Set a parameter of a module to a value."""

    module: int
    parameter: int
    value: int


class Change(NamedTuple):
    """Bits to clear and to set in one parameter; its other bits stay."""

    module: int
    parameter: int
    clear: int
    set: int


Order = Write | Change


def configure(which: Generation, settings: DvxplorerSettings) -> Iterator[Order]:
    """Yield the orders written before the stream starts."""
    return _parameters(settings) if which is Generation.PARAMETERS else _registers(settings)


def run(which: Generation) -> Iterator[Order]:
    """Yield the orders that start the stream. On firmware 9 this resets the camera's clock to zero."""
    if which is Generation.PARAMETERS:
        yield Write(DVS, RUN, 1)
    else:
        yield Write(SENSOR, 0x3238, 1)
        yield Write(SENSOR, 0x3238, 0)
        yield Write(SENSOR, SENSOR_MODE, STREAM)


def stop(which: Generation) -> Iterator[Order]:
    """Yield the orders that stop the stream.

    Also sent at the start, because the last program may have left it running.
    """
    if which is Generation.REGISTERS:
        yield Write(SENSOR, SENSOR_MODE, 0)
    yield Write(DVS, RUN, 0)
    yield from (Write(IMU, running, 0) for running in (2, 3, 4))


def _parameters(settings: DvxplorerSettings) -> Iterator[Order]:
    width, height = FRAME_PX
    yield Write(DVS, READOUT, list(READOUT_RATES).index(settings.readout_rate))
    yield Write(DVS, THRESHOLD_ON, settings.threshold_on)
    yield Write(DVS, THRESHOLD_OFF, settings.threshold_off)
    yield Write(DVS, FLATTEN, 0)
    yield from (Write(DVS, subsample, 0) for subsample in (5, 6))
    yield Write(DVS, 8, int(settings.global_hold))
    yield from (Write(DVS, global_reset, 0) for global_reset in (9, 10))
    yield from (Write(DVS, CROP + k, value) for k, value in enumerate((0, 0, width, height)))
    yield Write(DVS, APPLY_CROP, 0)
    yield Write(DVS, MIPI_TIMEOUT_ON, 1)
    yield Write(DVS, MIPI_TIMEOUT_US, settings.flush_us)
    for flip in (FLIP_X, FLIP_Y):
        yield Write(DVS, flip, 0)
        yield Write(DVS, APPLY_CROP, 0)
    # The motion sensor is neither configured nor started: evetac does not read it, and the Mini may have none.


def _registers(settings: DvxplorerSettings) -> Iterator[Order]:
    on, off = settings.threshold_on, settings.threshold_off
    bias = {
        0x0018: 0x04,
        0x000C: 0x14,
        0x000B: 0x04 if on < 9 else 0x06,
        0x0012: 0x7F if off < 9 else 0x7D,
        0x001C: on % 9,
        0x001E: 8 - off % 9,
    }
    yield from (Write(SENSOR, register, value) for register, value in bias.items())
    yield Write(SENSOR, 0x3260, 0)  # external trigger
    yield Change(SENSOR, 0x3255, clear=0x03, set=int(settings.global_hold))  # global hold, no global reset
    yield Write(SENSOR, 0x3248, 0)
    yield Write(SENSOR, 0x325C, 0)
    yield Change(SENSOR, 0x3067, clear=0x70, set=0)  # both polarities
    yield Change(SENSOR, 0x3200, clear=0, set=0x06)  # no area block
    yield Write(SENSOR, 0x3202, 0)
    yield Write(SENSOR, 0x3204, 0)  # every pixel
    for block in range(20):
        yield from _wide(0x3205 + 2 * block, 0x7FFF)
    yield from (Write(SENSOR, 0x3240 + k, value) for k, value in enumerate((0, 0, 2)))
    yield from (Write(SENSOR, 0x3244 + k, 0) for k in range(3))
    yield from (Write(SENSOR, 0x3256 + k, value) for k, value in enumerate((0, 0, 1)))
    timing = {0x323C: 4, 0x324C: 6, 0x324E: 4, 0x324F: 6, 0x3253: 8, 0x3254: 10}
    yield from (Write(SENSOR, register, value) for register, value in timing.items())
    yield from _wide(0x3261, 15)
    yield Write(SENSOR, 0x3251, 10)
    yield Write(SENSOR, 0x324B, 4)
    yield from _wide(0x325D, 900 * CLOCK_MHZ)
    yield Write(SENSOR, 0x3300, 1)  # no crop
    yield Write(SENSOR, 0x3500, 1)  # no activity filter
    yield Write(SENSOR, 0x3201, 2)
    yield from _readout(settings.readout_rate)


def _readout(rate: str) -> Iterator[Order]:
    fixed, read_us, hold_ms, hold_us, next_column, most_events = READOUT_RATES[rate]
    yield Write(SENSOR, 0x3201, 0)
    yield Write(SENSOR, 0x325C, fixed)
    yield from _wide(0x325D, read_us * CLOCK_MHZ)
    yield Write(SENSOR, 0x3240, hold_ms)
    yield from _wide(0x3241, hold_us)
    yield from _wide(0x3261, next_column)
    yield Write(SENSOR, 0x3251, most_events)
    yield Write(SENSOR, 0x3201, 1)


def _wide(register: int, value: int) -> Iterator[Order]:
    """Yield the writes of a 16-bit value to two neighbouring registers, high byte first."""
    yield Write(SENSOR, register, value >> 8)
    yield Write(SENSOR, register + 1, value & 0xFF)
