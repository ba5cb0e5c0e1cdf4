"""The grammar of device names: what the parser takes, opens; what it does not take, is refused in words."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.devices import cameras, grippers
from evetac_cli.devices.cameras import CameraSettings
from evetac_cli.devices.naming import CAMERA_FAULTS, EVENTS_S, GRIPPER_FAULTS
from evetac_cli.devices.virtual.gripper import Faults
from evetac_cli.devices.virtual.word_sources import random_event_words
from evetac_cli.errors import DeviceError, InputError

ODD = (
    "",
    "0",
    "-1",
    "1",
    "0.5",
    "2000",
    "1e999",
    "-1e999",
    "nan",
    "inf",
    "1e-999",
    "1_0",
    "５",
    "0x10",
    "1e5",
    "+",
    "@",
)
NUMBERS = st.one_of(
    st.sampled_from(ODD),
    st.integers(-10, 10**10).map(str),
    st.floats(0.0, 1e10).map(lambda value: f"{value:g}"),
    st.text("0123456789.e+-_", max_size=6),
)
LOW_RATE = 1e4  # of a stream that is opened: what it holds is asked of the words themselves


def option_texts() -> st.SearchStrategy[str]:
    """Options of a virtual camera, right and wrong."""
    fault = st.builds(
        lambda name, at, moment, colon, duration: name + at * f"@{moment}" + colon * f":{duration}",
        st.sampled_from([*CAMERA_FAULTS, "prepared", "firmware", "fire"]),
        *(st.booleans(), NUMBERS, st.booleans(), NUMBERS),
    )
    named = st.builds(lambda name, number: f"{name}={number}", st.sampled_from(["prepared", "firmware"]), NUMBERS)
    return st.lists(st.one_of(fault, named), max_size=3).map("+".join)


def opened_or_refused(camera: cameras.NamedCamera) -> None:
    """A camera opens and gives a slice, or a fault of its own keeps it from that, in words."""
    with suppress(DeviceError):
        running, setup, _ = camera.open(CameraSettings(), None, np.random.SeedSequence(0))
        assert setup["name"] == "virtual"
        try:
            running.read()
        finally:
            running.close()


@given(options=option_texts())
@settings(max_examples=25, deadline=None)
def test_what_a_camera_is_named_opens_or_is_refused(options: str) -> None:
    """Assert that a text with any numbers is an InputError that says what is expected, or a camera that opens."""
    try:
        camera = cameras.parse(f"virtual:{options}")
    except InputError as refused:
        assert "expected" in str(refused)
        return
    assert isinstance(camera, cameras.Virtual)
    rate = camera.prepared_events_s
    if rate is not None:
        assert len(random_event_words(rate, 2e-4, np.random.default_rng(0)))
    opened_or_refused(replace(camera, prepared_events_s=LOW_RATE))


@pytest.mark.parametrize("rate", EVENTS_S)
def test_the_ends_of_the_rate_open(rate: float) -> None:
    """Assert that both ends are names, hold as many events as they say, and are all that there is."""
    words = random_event_words(rate, 2e-4, np.random.default_rng(0))
    from evetac_cli.devices.dvxplorer.event_word_loops import events_in

    assert events_in(words) == round(rate * 2e-4)
    for text in (f"{rate}", f"{rate:g}", f"{rate:e}"):  # 5e+07: its plus is none between two options
        camera = cameras.parse(f"virtual:prepared={text}+unplug@1e+2")
        assert camera == cameras.Virtual(("unplug@1e+2",), rate)


REFUSED = [
    *(
        f"prepared={number}"
        for number in ("", "0", "1", "2000", "4999", "5e7x", "1e9", "nan", "inf", "1_0000", "-5000")
    ),
    *(f"firmware={number}" for number in ("", "0", "256", "9.5", "10.4", "1e9", "nan", "９")),
    *(f"unplug@{number}" for number in ("1e999", "-1", "nan", "x", "")),
    *(f"silence@1:{number}" for number in ("0", "0.0", "1e999", "1e-999", "-1", "")),
    *("prepared=5000+prepared=6000", "firmware=9+firmware=10", "prepared@1", "firmware"),
]


@pytest.mark.parametrize("options", REFUSED)
def test_numbers_that_no_virtual_camera_has(options: str) -> None:
    """Assert that what could not be opened, or would mean something else, is refused with its range."""
    with pytest.raises(InputError) as refused:
        cameras.parse(f"virtual:{options}")
    assert "expected" in str(refused.value) and "found" in str(refused.value)


def fault_texts() -> st.SearchStrategy[str]:
    """Faults of a virtual gripper, right and wrong."""
    fault = st.builds(
        lambda name, part, share, at, moment, colon, duration: (
            name + part * f"%{share}" + at * f"@{moment}" + colon * f":{duration}"
        ),
        st.sampled_from([*GRIPPER_FAULTS, "fire"]),
        *(st.booleans(), NUMBERS, st.booleans(), NUMBERS, st.booleans(), NUMBERS),
    )
    return st.lists(fault, max_size=3).map("+".join)


@given(text=fault_texts())
@settings(max_examples=300, deadline=None)
def test_what_a_virtual_gripper_is_named_runs_or_is_refused(text: str) -> None:
    """Assert that a text with any numbers is an InputError, or faults that come and go on the servo's clock."""
    from evetac_cli.devices.naming import gripper_fault
    from evetac_cli.devices.virtual.servo import Answer

    try:
        gripper = grippers.parse(f"virtual:{text}")
    except InputError as refused:
        assert "expected" in str(refused)
        return
    assert isinstance(gripper, grippers.Virtual)
    kinds = [gripper_fault(each) for each in gripper.faults]
    faults = Faults(list(kinds), np.random.default_rng(0))
    for now_s in (0.0, 1.0, 1e3, 1e9):
        assert set(faults.due(now_s, torque=True)) <= set(GRIPPER_FAULTS)
        faults.spoil(Answer(b"ab", 0.0), now_s, torque=True)
        faults.false_readings(now_s)
    assert all(np.isfinite([kind.start_s or 0.0, kind.duration_s, kind.share]).all() for kind in kinds)


@given(port=st.sampled_from(["/dev/ttyUSB0", "COM3", "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"]),
       id_=st.one_of(st.none(), NUMBERS), rate=st.one_of(st.none(), NUMBERS))  # fmt: skip
@settings(max_examples=300, deadline=None)
def test_what_a_port_is_named_can_be_spoken_to_or_is_refused(port: str, id_: Any, rate: Any) -> None:
    """Assert that id and rate are those that were written, within what the driver takes, or an InputError."""
    text = port + ("" if id_ is None else f":{id_}") + ("" if rate is None else f"@{rate}")
    try:
        gripper = grippers.parse(text)
    except InputError as refused:
        assert "expected" in str(refused) and "--gripper" in str(refused)
        return
    assert isinstance(gripper, grippers.Serial)
    made = gripper.settings()
    assert 0 <= made.id <= 252 and gripper.baud in grippers.SDK_RATES
    assert rate is None or float(rate) == gripper.baud
    assert grippers.parse(str(gripper)) == gripper
    if gripper.port == port and id_ is not None:
        assert float(id_) == gripper.id
