"""Read a gripper's measurements in one transaction, reject impossible values, and detect a restart of the servo.

Reason: a checksum shows that an answer arrived as sent, not that it makes sense. A servo with a broken encoder, memory
or supply sends values that no finger can have, and the control law would follow them. After a dip of its 24 V supply, a
servo is back within some ms: without torque, without its watchdog, without a hardware error, and it accepts every
command. To detect this, every TICK_EVERY-th reading includes Realtime Tick (ms since power-on). That block begins 6
bytes earlier, which costs 0.6 bytes per reading. Torque Enable is 62 bytes away and would double the reading. If the
tick has gone back, Torque Enable is read: only 0 means a restart, or another program's action.

Reason for the bounds: a servo's limits apply to its goals. In current mode fingers are driven against their stop and
bend under load, so positions some ticks beyond the limits are normal: BEYOND_TICKS is a tenth of the fingers' range. A
finger moves 2 ticks per ms at the servo's top speed (29.7 rpm), so a position three times that far away was not
reached. The motor's peak current is 3.33 A (e-Manual). Beyond the limits of supply and temperature a servo raises a
hardware error, which ends the run anyway; a reading well beyond them without that error is not a measurement.
"""

import time
from collections.abc import Callable
from typing import TypeVar

from evetac_cli.devices import GripperReading
from evetac_cli.devices.rh_p12_rn.control_table import BEYOND_TICKS, REGISTERS
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus
from evetac_cli.devices.rh_p12_rn.torque import Torque
from evetac_cli.errors import DeviceError

TICK_EVERY = 10  # readings: 20 ms at 500 per second
TICK_WRAPS_MS = 32768
TICK_SLACK_MS = 1000.0  # a servo's clock that is ahead of the host's by less than this did not restart
FASTEST_TICKS_MS = 6.0
MOST_MA = 4000
SUPPLY_SHARES = 0.8, 1.2  # factors on the lower and the upper limit
HOT_C = 20  # degrees beyond the limit
_T = TypeVar("_T")
_TICK, _CURRENT, _POSITION = (REGISTERS[name] for name in ("Realtime Tick", "Present Current", "Present Position"))
_END = _POSITION.address + _POSITION.size
_SUPPLY = REGISTERS["Present Input Voltage"].address
_SUPPLY_SIZE = REGISTERS["Present Temperature"].address + REGISTERS["Present Temperature"].size - _SUPPLY


class Impossible(DeviceError):
    """A reading that is impossible for a servo."""


class Measurements:
    """The readings of one gripper on an open bus; `impossible` counts readings that were rejected and repeated."""

    def __init__(self, bus: Bus, torque: Torque) -> None:
        self._bus, self._torque = bus, torque
        self._readings = self.impossible = 0
        self._last: tuple[int, float] | None = None  # position, and when its request began
        self._tick: tuple[int, float] | None = None  # the servo's clock, and when its request began

    def set_up(self) -> None:
        """Read the limits that readings are checked against."""
        read = self._bus.read
        self.limits_ticks = read("Min Position Limit"), read("Max Position Limit")
        self._volts = tuple(
            share * read(f"{which} Voltage Limit") / 10
            for share, which in zip(SUPPLY_SHARES, ("Min", "Max"), strict=True)
        )
        self._most_c = read("Temperature Limit") + HOT_C

    def read(self) -> GripperReading:
        """Return present current (mA) and position (ticks); DeviceError if they are impossible or torque was lost."""
        return self._twice(self._read)

    def require_supply(self) -> None:
        """Raise DeviceError if the supply voltage or the temperature is impossible."""
        self._twice(self._check_supply)

    def require_torque(self, restart: str = "") -> None:
        """Raise DeviceError if this program switched torque on and it is off; restart: the evidence for a restart."""
        if self._torque.is_on and self._bus.read("Torque Enable") == 0:
            restarted = "restarted and " if restart else ""
            dip = "did its 24 V dip, so that it restarted, or did another program switch torque off?"
            raise DeviceError(
                f"the gripper {restarted}lost torque: the held object may have fallen",
                where=self._where,
                expected="Torque Enable 1, as this program wrote it",
                found=f"0{restart}",
                hint="did its 24 V dip? check supply and cable" if restart else dip,
            )

    @property
    def _where(self) -> str:
        return f"gripper {self._bus.id} at {self._bus.port}"

    def _twice(self, ask: Callable[[], _T]) -> _T:
        """Return the result of `ask`; after an impossible reading a second one decides, as after a lost answer."""
        try:
            return ask()
        except Impossible:
            self.impossible += 1
            return ask()

    def _read(self) -> GripperReading:
        begins = _CURRENT if self._readings % TICK_EVERY else _TICK
        self._readings += 1
        begun_s = time.monotonic()
        data = self._bus.read_bytes(begins.address, _END - begins.address)
        if begins is _TICK:
            self._look_at_the_clock(_TICK.decode(data[: _TICK.size]), begun_s)
            data = data[_CURRENT.address - _TICK.address :]
        current_ma, position_ticks = _CURRENT.decode(data[: _CURRENT.size]), _POSITION.decode(data[-_POSITION.size :])
        self._check(current_ma, position_ticks, begun_s)
        self._last = position_ticks, begun_s
        return GripperReading(float(current_ma), position_ticks)

    def _look_at_the_clock(self, tick_ms: int, begun_s: float) -> None:
        """Check torque if the servo's clock has gone back, other than by its wrap."""
        before, self._tick = self._tick, (tick_ms, begun_s)
        if before is None:
            return
        passed_ms = (time.monotonic() - before[1]) * 1e3
        if (tick_ms - before[0]) % TICK_WRAPS_MS > passed_ms + TICK_SLACK_MS:
            self.require_torque(f"; Realtime Tick fell from {before[0]:,} to {tick_ms:,} ms")

    def _check(self, current_ma: int, position_ticks: int, begun_s: float) -> None:
        if abs(current_ma) > MOST_MA:
            raise self._impossible("current", f"at most {MOST_MA:,} mA in either direction", f"{current_ma:,} mA")
        (lowest, highest), shown = self.limits_ticks, f"{position_ticks:,} ticks"
        if not lowest - BEYOND_TICKS <= position_ticks <= highest + BEYOND_TICKS:
            about = (
                f"{lowest - BEYOND_TICKS:,} to {highest + BEYOND_TICKS:,} ticks, for limits of {lowest} to {highest}"
            )
            raise self._impossible("position", about, shown)
        if self._last is None:
            return
        before, asked_s = self._last
        passed_ms = (time.monotonic() - asked_s) * 1e3
        reach = BEYOND_TICKS + FASTEST_TICKS_MS * passed_ms
        if abs(position_ticks - before) > reach:
            about = f"at most {reach:,.0f} ticks from {before:,}, its position {passed_ms:.0f} ms earlier"
            raise self._impossible("position", about, shown)

    def _check_supply(self) -> None:
        data = self._bus.read_bytes(_SUPPLY, _SUPPLY_SIZE)
        volts, temperature_c = int.from_bytes(data[:2], "little") / 10, data[2]
        low, high = self._volts
        if not low <= volts <= high:
            raise self._impossible("supply", f"{low:g} to {high:g} V", f"{volts:g} V")
        if temperature_c > self._most_c:
            raise self._impossible("temperature", f"at most {self._most_c} C", f"{temperature_c} C")

    def _impossible(self, what: str, expected: str, shown: str) -> Impossible:
        return Impossible(
            f"the gripper reports an impossible {what}: {shown}",
            where=self._where,
            expected=expected,
            hint="switch 24 V off and on; if it happens again, the gripper is damaged",
        )
