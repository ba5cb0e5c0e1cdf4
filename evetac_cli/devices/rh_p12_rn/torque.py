"""Torque of the gripper: on only with its Bus Watchdog armed and goals that move nothing; off only if read back as off.

The servo's Bus Watchdog counts from the last instruction of any kind, while torque is on (e-Manual, register 546). When
it trips, the motor stops and goals are refused, but Torque Enable stays 1 until a program writes 0.

Reason: a program that is killed between two of these steps must not leave torque without a watchdog. So the watchdog is
armed first and read back, and switched off last. It is cleared only without torque, because under torque a motor that
it had stopped could grip again. Goal Current is 0 before torque is switched on; in position mode this is a limit of 0
mA (register 550). Goal Position is the present position, so nothing moves even if a firmware interprets that limit
differently.
"""

import contextlib
from typing import Literal

from evetac_cli.devices.rh_p12_rn.control_table import WATCHDOG_MS, check_model
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import ANSWER_MS, Bus, PortGone
from evetac_cli.errors import DeviceError

RELEASE_TRIES = 5
SETTLE_S = 0.1  # used if there is time to wait for a late answer
IS_OFF = "torque is off (read back)"
State = Literal["not known", "off", "on"]


class Torque:
    """Torque of one gripper on an open bus; `words` describe its known state at any time."""

    def __init__(self, bus: Bus, watchdog_ms: int, state: State = "not known") -> None:
        """state: "not known" if another program may have left it on, "on" if it is known to have been on."""
        self._bus, self._watchdog_ms, self._state = bus, watchdog_ms, state
        self.words = "torque has not been read yet"

    @property
    def is_on(self) -> bool:
        """Whether this program switched torque on, and has not switched it off since."""
        return self._state == "on"

    def clear(self) -> None:
        """Switch torque off and clear the watchdog, from any previous state; DeviceError if torque stays on."""
        self._bus.write("Torque Enable", 0)
        if self._bus.read("Torque Enable") != 0:
            raise DeviceError(
                "the gripper did not switch torque off",
                where=f"gripper at {self._bus.port}",
                expected="Torque Enable 0",
                found="1",
                hint="switch 24 V off and on",
            )
        self._bus.write("Bus Watchdog", 0)
        self._state, self.words = "off", "torque is off: no command has been sent yet"

    def switch_on(self, goal_ticks: int | None) -> None:
        """Write goals that move nothing, arm the watchdog, switch torque on; DeviceError if a step is not confirmed.

        goal_ticks: the present position of the fingers in position mode; None in current mode.
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
        self._state, self.words = "on", "torque is on"  # also if the answer to the next write is lost
        bus.write("Torque Enable", 1)

    def switch_off(self) -> bool:
        """Set current 0 and torque off; return whether off was read back.

        `words` report it, and what happens otherwise.

        A Ctrl-C during this call takes effect after it.
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
                        bus.write("Goal Current", 0)  # refused before if the watchdog had tripped
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
    """Switch torque off after the process that drove the gripper has died; return a sentence on what was read back.

    The fingers are not opened. watchdog_ms: the watchdog time that the dead process had set. If the port cannot be
    opened or does not answer, the sentence reports that.
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
        "not known": "if another program left it on, it is still on: switch 24 V off",
    }
    return f"torque could not be read back as off: {why}; {then[state]}"
