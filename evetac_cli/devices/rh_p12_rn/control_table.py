"""Control table of the ROBOTIS RH-P12-RN(A) as data: address, writable values and unit of each register.

Sources: ROBOTIS e-Manual (rh-p12-rna), the maker's model file rh_p12_rn.model, and a driver of Evetac's authors. These
differ in Current Limit (1984 or 661), Max Voltage Limit (350 or 300) and Shutdown (52 or 58). The defaults here are
only those of the virtual servo: a driver reads the values from its device.
"""

from dataclasses import dataclass

from evetac_cli.errors import DeviceError

MODEL_NUMBER = 35074  # RH-P12-RN(A)
OLD_MODEL_NUMBER = 35073  # RH-P12-RN: looks the same, has a different control table
RAM_START = 512  # addresses below are EEPROM, which is locked while torque is on
TABLE_SIZE = 608  # without the indirect registers behind, which evetac does not use
BEYOND_TICKS = 64  # positions this far beyond the limits are measured where fingers bend, see measurements.py
CURRENT_MODE, POSITION_MODE = 0, 5  # values of Operating Mode; in position mode Goal Current limits the current
WATCHDOG_MS = 20  # unit of Bus Watchdog
WATCHDOG_TRIPPED = -1  # the value of Bus Watchdog after it tripped
RETURN_DELAY_US = 2  # unit of Return Delay Time
RPM = 0.01  # unit of speeds

BAUD_RATES = {  # values of Baud Rate
    0: 9_600,
    1: 57_600,  # factory
    2: 115_200,
    3: 1_000_000,
    4: 2_000_000,
    5: 3_000_000,
    6: 4_000_000,
    7: 4_500_000,
    8: 6_000_000,
    9: 10_500_000,
}

# rates that the maker's dynamixel-sdk can set
SDK_RATES = tuple(rate for rate in BAUD_RATES.values() if rate <= 4_000_000)
LAST_ID = 252

HARDWARE_ERRORS = ("input voltage", "hall sensor", "overheating", "encoder", "electrical shock", "overload")  # bits 0-5


@dataclass(frozen=True)
class Register:
    """One entry: `size` bytes at `address`, little-endian; values in [low, high] or in `only` may be written."""

    name: str
    address: int
    size: int
    default: int
    low: int = 0
    high: int = 0
    unit: str = ""
    signed: bool = False
    writable: bool = True
    only: tuple[int, ...] = ()

    @property
    def eeprom(self) -> bool:
        """Whether the value survives a power cycle, and is locked while torque is on."""
        return self.address < RAM_START

    def decode(self, data: bytes | bytearray) -> int:
        """Return the value of the register's bytes; ValueError if their number is wrong."""
        if len(data) != self.size:
            raise ValueError(f"{self.name} has {self.size} bytes, found {len(data)}")
        return int.from_bytes(data, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """Return the bytes of a value; ValueError if it does not fit. Writable values may have a smaller range."""
        try:
            return value.to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            raise ValueError(f"{self.name} has {self.size} bytes, too few for {value}") from None

    def accepts(self, value: int) -> bool:
        """Return whether the value may be written."""
        return value in self.only if self.only else self.low <= value <= self.high


def _read_only(name: str, address: int, size: int, default: int = 0, unit: str = "", signed: bool = False) -> Register:
    return Register(name, address, size, default, unit=unit, signed=signed, writable=False)


_EEPROM = (
    _read_only("Model Number", 0, 2, MODEL_NUMBER),
    _read_only("Model Information", 2, 4),
    _read_only("Firmware Version", 6, 1, 14),
    Register("ID", 7, 1, 1, 0, LAST_ID),
    Register("Baud Rate", 8, 1, 1, 0, 9),
    Register("Return Delay Time", 9, 1, 250, 0, 254, "2 us"),
    Register("Operating Mode", 11, 1, POSITION_MODE, only=(CURRENT_MODE, POSITION_MODE)),
    Register("Secondary ID", 12, 1, 255, 0, 255),
    Register("Protocol Type", 13, 1, 2, only=(2, 10)),
    Register("Homing Offset", 20, 4, 0, -1_044_479, 1_044_479, "tick", signed=True),
    Register("Moving Threshold", 24, 4, 80, 0, 2970, "0.01 rpm"),
    Register("Temperature Limit", 31, 1, 80, 0, 100, "C"),
    Register("Max Voltage Limit", 32, 2, 350, 0, 350, "0.1 V"),
    Register("Min Voltage Limit", 34, 2, 150, 0, 350, "0.1 V"),
    Register("PWM Limit", 36, 2, 2009, 0, 2009, "0.05 %"),
    Register("Current Limit", 38, 2, 661, 0, 1984, "mA"),
    Register("Acceleration Limit", 40, 4, 3447, 0, 3447, "rpm2"),
    Register("Velocity Limit", 44, 4, 2970, 0, 2970, "0.01 rpm"),
    Register("Max Position Limit", 48, 4, 1150, 0, 1150, "tick"),
    Register("Min Position Limit", 52, 4, 0, 0, 1150, "tick"),
    *(Register(f"External Port Mode {k + 1}", 56 + k, 1, 3, 0, 3) for k in range(4)),
    Register("Shutdown", 63, 1, 0b110100, 0, 0b111111),
)

_RAM = (
    Register("Torque Enable", 512, 1, 0, 0, 1),
    Register("LED Red", 513, 1, 0, 0, 255),
    Register("LED Green", 514, 1, 0, 0, 255),
    Register("LED Blue", 515, 1, 0, 0, 255),
    Register("Status Return Level", 516, 1, 2, 0, 2),
    _read_only("Registered Instruction", 517, 1),
    _read_only("Hardware Error Status", 518, 1),
    Register("Velocity I Gain", 524, 2, 0, 0, 32767),
    Register("Velocity P Gain", 526, 2, 0, 0, 32767),
    Register("Position D Gain", 528, 2, 0, 0, 32767),
    Register("Position I Gain", 530, 2, 0, 0, 32767),
    Register("Position P Gain", 532, 2, 193, 0, 32767),
    Register("Feedforward 2nd Gain", 536, 2, 0, 0, 32767),
    Register("Feedforward 1st Gain", 538, 2, 0, 0, 32767),
    Register("Bus Watchdog", 546, 1, 0, 0, 127, "20 ms", signed=True),
    Register("Goal PWM", 548, 2, 2009, -2009, 2009, "0.05 %", signed=True),
    Register("Goal Current", 550, 2, 0, -1984, 1984, "mA", signed=True),
    Register("Goal Velocity", 552, 4, 2970, -2970, 2970, "0.01 rpm", signed=True),
    Register("Profile Acceleration", 556, 4, 0, 0, 3447, "rpm2"),
    Register("Profile Velocity", 560, 4, 0, 0, 2970, "0.01 rpm"),
    Register("Goal Position", 564, 4, 0, 0, 1150, "tick", signed=True),
    _read_only("Realtime Tick", 568, 2, unit="ms"),
    _read_only("Moving", 570, 1),
    _read_only("Moving Status", 571, 1),
    _read_only("Present PWM", 572, 2, unit="0.05 %", signed=True),
    _read_only("Present Current", 574, 2, unit="mA", signed=True),
    _read_only("Present Velocity", 576, 4, unit="0.01 rpm", signed=True),
    _read_only("Present Position", 580, 4, unit="tick", signed=True),
    _read_only("Velocity Trajectory", 584, 4, unit="0.01 rpm", signed=True),
    _read_only("Position Trajectory", 588, 4, unit="tick", signed=True),
    _read_only("Present Input Voltage", 592, 2, 240, "0.1 V"),
    _read_only("Present Temperature", 594, 1, 35, "C"),
    _read_only("Grip Detection", 595, 1),
    *(Register(f"External Port Data {k + 1}", 600 + 2 * k, 2, 0, 0, 4095) for k in range(4)),
)

TABLE = _EEPROM + _RAM
REGISTERS = {register.name: register for register in TABLE}
BY_ADDRESS = {register.address: register for register in TABLE}


def baud_code(baud: int) -> int:
    """Return the value of the register Baud Rate for a rate in bit/s; ValueError if the gripper has no such rate."""
    for code, rate in BAUD_RATES.items():
        if rate == baud:
            return code
    raise ValueError(f"expected one of {', '.join(map(str, BAUD_RATES.values()))} baud, found {baud}")


def hardware_errors(status: int) -> list[str]:
    """Return the names of the bits set in Hardware Error Status."""
    errors = [name for bit, name in enumerate(HARDWARE_ERRORS) if status >> bit & 1]
    return errors + [f"bit {bit}" for bit in range(len(HARDWARE_ERRORS), 8) if status >> bit & 1]


def check_model(model: int, where: str) -> None:
    """Raise DeviceError unless the model number is that of an RH-P12-RN(A)."""
    if model == MODEL_NUMBER:
        return
    older = (
        "the older RH-P12-RN, which has a different control table" if model == OLD_MODEL_NUMBER else "another device"
    )
    raise DeviceError(
        "this driver is for the RH-P12-RN(A)",
        where=where,
        expected=f"model number {MODEL_NUMBER}",
        found=f"{model}: {older}",
    )
