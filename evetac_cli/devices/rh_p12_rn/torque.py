"""Torque of the gripper: on only under its Bus Watchdog and from goals that move nothing; off as it was read back.

The servo's Bus Watchdog counts from the last instruction, any instruction, while torque is on (e-Manual, register 546).
When it trips, the motor stops and goals are refused, but Torque Enable stays 1 until somebody writes 0.

Why so: whoever is killed between two of these steps must leave no torque without a watchdog, so the watchdog is armed
first and read back, and switched off last. It is cleared only without torque: cleared under torque, a motor that it
had stopped could grip again. Goal Current is 0 before torque, which in position mode is a limit of 0 mA (register 550),
and Goal Position is where the fingers are, so that nothing moves even if a firmware takes that limit otherwise.
"""

import contextlib
from typing import Literal

from evetac_cli.devices.rh_p12_rn.control_table import WATCHDOG_MS, check_model
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS, Bus, PortGone
from evetac_cli.errors import DeviceError

RELEASE_TRIES = 5
SETTLE_S = 0.1  # where there is time to wait for an answer that is late
IS_OFF = "torque is off (read back)"
State = Literal["not known", "off", "on"]


class Torque:
    """Torque of one gripper on an open bus; `words` say at any time what is known of it."""

    def __init__(self, bus: Bus, watchdog_ms: int, state: State = "not known") -> None:
        """state: "not known" where another program may have left it on, "on" where it is known to have run so."""
        self._bus, self._watchdog_ms, self._state = bus, watchdog_ms, state
        self.words = "torque was not read yet"

    @property
    def is_on(self) -> bool:
        """Whether it was switched on here, and not off since."""
        return self._state == "on"

    def clear(self) -> None:
        """Torque off and the watchdog cleared, whatever another program left behind; DeviceError if it stays on."""
        self._bus.write("Torque Enable", 0)
        if self._bus.read("Torque Enable") != 0:
            raise DeviceError(
                "the gripper does not switch torque off",
                where=f"gripper at {self._bus.port}",
                expected="Torque Enable 0",
                found="1",
                hint="switch 24 V off and on",
            )
        self._bus.write("Bus Watchdog", 0)
        self._state, self.words = "off", "torque is off: no command was given yet"

    def switch_on(self, goal_ticks: int | None) -> None:
        """Goals that move nothing, the watchdog, torque; DeviceError if one of them is not confirmed.

        goal_ticks: where the fingers are, in position mode; None in current mode.
        """
        bus, code = self._bus, self._watchdog_ms // WATCHDOG_MS
        bus.write("Goal Current", 0)
        if goal_ticks is not None:
            bus.write("Goal Position", goal_ticks)
        bus.write("Bus Watchdog", code)
        if (armed := bus.read("Bus Watchdog")) != code:
            raise DeviceError(
                "the gripper's bus watchdog cannot be armed, so torque stays off",
                where=f"gripper at {bus.port}",
                expected=f"Bus Watchdog {code} ({self._watchdog_ms} ms)",
                found=str(armed),
                hint="is its firmware up to date?",
            )
        self._state, self.words = "on", "torque is on"  # also if the answer to what follows is lost
        bus.write("Torque Enable", 1)

    def switch_off(self) -> bool:
        """Current 0, torque off; whether that was read back. `words` say which, and what happens if not.

        Ctrl-C meanwhile takes effect after it.
        """
        try:
            return self._switch_off()
        except KeyboardInterrupt:
            self._switch_off()
            raise

    def _switch_off(self) -> bool:
        bus = self._bus
        bus.tolerant = True
        why = ""
        for _ in range(RELEASE_TRIES):
            try:
                bus.send("Goal Current", 0)
                bus.write("Torque Enable", 0)
                if (torque := bus.read("Torque Enable")) == 0:
                    with contextlib.suppress(DeviceError):
                        bus.write("Bus Watchdog", 0)
                        bus.write("Goal Current", 0)  # refused before, if the watchdog had tripped
                    self._state, self.words = "off", IS_OFF
                    return True
                why = f"Torque Enable reads {torque}, though 0 was written"
            except DeviceError as error:
                why = error.message
                if isinstance(error, PortGone):
                    break
                bus.settle_s = SETTLE_S
        self.words = _not_read_back(why, self._state, self._watchdog_ms)
        return False


def release(port: str, baud: int, *, id_: int = 1, watchdog_ms: int = 100, answer_ms: float = ANSWER_MS) -> str:
    """Torque off after the process that drove the gripper has died; in words, what was read back.

    The fingers are not opened. watchdog_ms: what that process had set. Where the port cannot be opened or does not
    answer, the words say so.
    """
    try:
        with Bus(port, baud, id_, answer_ms=answer_ms) as bus:
            bus.tolerant = True
            check_model(bus.ping(), f"gripper at {port}")
            torque = Torque(bus, watchdog_ms, "on")
            torque.switch_off()
            return torque.words
    except DeviceError as error:
        return _not_read_back(error.message, "on", watchdog_ms)


def _not_read_back(why: str, state: State, watchdog_ms: int) -> str:
    then = {
        "on": f"its watchdog stops the motor {watchdog_ms} ms after the last instruction;"
        " Torque Enable stays 1 until the next start",
        "off": "this program never switched it on",
        "not known": "if another program left it on it still is: switch 24 V off",
    }
    return f"torque could not be read back as off: {why}; {then[state]}"
