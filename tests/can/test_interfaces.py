"""CAN interfaces as the kernel lists them, and a driver that asks whether its own is up."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.can import channels
from hil.can.channels import can_interfaces, is_up
from hil_drivers.cia402.can_channel import CanChannel

UP, DOWN, NO_NUMBER = "0x40081\n", "0x40080\n", "\n"


def kernel(folder: Path, **flags: str | None) -> Path:
    """A list of CAN interfaces; one with None vanishes before its flags are read."""
    for name, text in flags.items():
        (folder / name).mkdir()
        (folder / name / "type").write_text("280\n")
        if text is None:
            (folder / name / "flags").mkdir()
        else:
            (folder / name / "flags").write_text(text)
    return folder


def test_interfaces_are_up_down_or_not_there(tmp_path: Path) -> None:
    network = kernel(tmp_path, can0=UP, can1=DOWN, gone=None, odd=NO_NUMBER)
    (network / "eth0").mkdir()
    (network / "eth0" / "type").write_text("1\n")
    assert can_interfaces(network) == ["can0", "can1", "gone", "odd"]
    told = [is_up(name, network) for name in ("can0", "can1", "gone", "odd", "none")]
    assert told == [True, False, None, None, None]


@pytest.mark.parametrize(
    ("flags", "passed", "message"),
    [
        (UP, True, "socketcan can0 is up"),
        (DOWN, False, "socketcan can0 is down"),
        (None, False, "there is no interface can0"),
        (NO_NUMBER, False, "there is no interface can0"),
    ],
)
def test_a_driver_tells_of_its_interface_and_never_raises(
    flags: str | None, passed: bool, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = kernel(tmp_path, can0=flags)
    monkeypatch.setattr(channels.is_up, "__defaults__", (network,))
    told = CanChannel("socketcan", "can0", 500_000).finding()
    assert (told.passed, told.message) == (passed, message)
    if flags == DOWN:
        assert told.hint == "sudo ip link set can0 up type can bitrate 500000"
