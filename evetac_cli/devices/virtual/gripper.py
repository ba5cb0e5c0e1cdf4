"""A virtual RH-P12-RN(A): a servo in its own process on a pseudo terminal, which the real driver opens as a port.

    with VirtualGripper(faults=["lost-answer@1.0"]) as gripper:
        driver = RhP12Rn(gripper.port)

Simulated. The process sleeps while it has nothing to do. It ends with its parent, however the parent ends.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from types import MappingProxyType
from typing import Any

from evetac_cli.devices.rh_p12_rn.control_table import baud_code
from evetac_cli.devices.virtual.faults import gripper_fault
from evetac_cli.devices.virtual.servo_plant import Obstacle, SharedPlant
from evetac_cli.errors import DeviceError, exit_code_words
from evetac_cli.realtime.last_words import with_reason
from evetac_cli.resources import PACKAGE

END_S = 5.0


class VirtualGripper(AbstractContextManager["VirtualGripper"]):
    """A servo on a pseudo terminal; `port` is its path."""

    counted: Mapping[str, int] = MappingProxyType({})

    def __init__(
        self,
        plant: SharedPlant | Obstacle | None = None,
        faults: Iterable[str] = (),
        *,
        baud: int = 2_000_000,
        registers: Mapping[str, int] | None = None,
        position_ticks: float = 400.0,
        seed: int = 0,
    ) -> None:
        """Start the process; when this returns, the servo is listening.

        plant: the gripper of a world that another process steps, or an obstacle for the servo's own drive, which starts
        at position_ticks.

        faults: as in faults.py; registers: values that differ from the factory values, by name; seed: for the faults
        that strike at random.
        """
        if isinstance(plant, SharedPlant):
            plant_config: dict[str, Any] = {"shared": str(plant.path)}
        else:
            plant_config = {"obstacle": vars(plant) if plant else None, "position_ticks": position_ticks}
        choice = {
            "plant": plant_config,
            "faults": [_checked(fault) for fault in faults],
            "registers": {"Baud Rate": baud_code(baud), **(registers or {})},
            "seed": seed,
        }
        python_path = os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]))
        self._process = subprocess.Popen(
            # -P: ignores the working folder, where a user may have a json.py
            [sys.executable, "-P", "-m", "evetac_cli.devices.virtual.servo_process", json.dumps(choice)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": python_path},
            start_new_session=True,
        )
        try:
            self.port: str = self._receive()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id of the servo."""
        return self._process.pid

    def inject(self, fault: str) -> None:
        """Let a fault strike at once, or according to the time or probability in its text."""
        self._ask(inject=_checked(fault))

    def faults_struck(self) -> dict[str, int]:
        """Return how often each fault has struck so far, by name; faults that did not strike are missing."""
        return {str(name): int(times) for name, times in self._ask(struck=True).items()}

    def read_register(self, register: str) -> int:
        """Return the value of a register, read without the serial port."""
        return int(self._ask(read=register))

    def instructions(self) -> dict[int, int]:
        """Return how often the servo received each instruction."""
        return {int(code): count for code, count in self._ask(instructions=True).items()}

    def close(self) -> None:
        """End the process; a second call does nothing."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self._process.stdin.closed:
            return
        self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, **question: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(question).encode() + b"\n")
        self._process.stdin.flush()
        return self._receive()

    def _receive(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            words = with_reason("the process of the virtual gripper died", exit_code_words(self._process.returncode))
            raise DeviceError(words, hint="its last messages, if any, are above")
        return json.loads(line)


def _checked(fault: str) -> str:
    """Return the text of a fault; InputError if it does not exist."""
    gripper_fault(fault)
    return fault
