"""The control table as data: it agrees with the manual's layout and with itself."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.devices.rh_p12_rn.control_table import (
    BAUD_RATES,
    BY_ADDRESS,
    REGISTERS,
    TABLE,
    TABLE_SIZE,
    Register,
    baud_code,
    hardware_errors,
)

# name, address, size, signed, writable: of the e-Manual, those that a driver needs
MANUAL = [
    ("Model Number", 0, 2, False, False),
    ("Firmware Version", 6, 1, False, False),
    ("ID", 7, 1, False, True),
    ("Baud Rate", 8, 1, False, True),
    ("Return Delay Time", 9, 1, False, True),
    ("Operating Mode", 11, 1, False, True),
    ("Current Limit", 38, 2, False, True),
    ("Max Position Limit", 48, 4, False, True),
    ("Min Position Limit", 52, 4, False, True),
    ("Torque Enable", 512, 1, False, True),
    ("Status Return Level", 516, 1, False, True),
    ("Hardware Error Status", 518, 1, False, False),
    ("Position P Gain", 532, 2, False, True),
    ("Bus Watchdog", 546, 1, True, True),
    ("Goal Current", 550, 2, True, True),
    ("Goal Position", 564, 4, True, True),
    ("Realtime Tick", 568, 2, False, False),
    ("Present Current", 574, 2, True, False),
    ("Present Velocity", 576, 4, True, False),
    ("Present Position", 580, 4, True, False),
]


@pytest.mark.parametrize(("name", "address", "size", "signed", "writable"), MANUAL)
def test_registers_lie_where_the_manual_says(name: str, address: int, size: int, signed: bool, writable: bool) -> None:
    """Assert that a register has the manual's address, size, sign and access."""
    register = REGISTERS[name]
    assert (register.address, register.size, register.signed, register.writable) == (address, size, signed, writable)
    assert register.eeprom == (address < 512)


def test_registers_do_not_overlap() -> None:
    """Assert that names and addresses are unique, that no byte belongs to two registers, and that all fit in."""
    taken = [place for register in TABLE for place in range(register.address, register.address + register.size)]
    assert len(taken) == len(set(taken))
    assert max(taken) == TABLE_SIZE - 1
    assert len(REGISTERS) == len(BY_ADDRESS) == len(TABLE)


def test_defaults_are_values_that_may_be_written() -> None:
    """Assert that a default fits into its bytes, and is within the range of a register that may be written."""
    for register in TABLE:
        assert register.decode(register.encode(register.default)) == register.default, register.name
        assert register.accepts(register.default) or not register.writable, register.name
        for value in (*register.only, register.low, register.high):
            register.encode(value)


@given(st.sampled_from(TABLE), st.integers(-(2**33), 2**33))
def test_values_survive_their_bytes(register: Register, value: int) -> None:
    """Assert that a value is the same after encoding and decoding, or refused because it does not fit."""
    bits = 8 * register.size
    fits = -(2 ** (bits - 1)) <= value < 2 ** (bits - 1) if register.signed else 0 <= value < 2**bits
    if not fits:
        with pytest.raises(ValueError, match=register.name):
            register.encode(value)
        return
    data = register.encode(value)
    assert register.decode(data) == value
    with pytest.raises(ValueError, match="bytes, found"):
        register.decode(data + b"\0")


def test_baud_rates() -> None:
    """Assert that each rate has the code that stands for it, and that others are refused."""
    assert [baud_code(rate) for rate in BAUD_RATES.values()] == list(BAUD_RATES)
    assert (BAUD_RATES[1], BAUD_RATES[4]) == (57_600, 2_000_000)
    with pytest.raises(ValueError, match="115000"):
        baud_code(115_000)


def test_hardware_errors_are_named() -> None:
    """Assert that each bit has its name, and that unknown bits are not lost."""
    assert hardware_errors(0) == []
    assert hardware_errors(0b100001) == ["input voltage", "overload"]
    assert hardware_errors(0b11000100) == ["overheating", "bit 6", "bit 7"]
