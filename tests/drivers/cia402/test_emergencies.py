"""Error codes, error registers and SDO aborts in words."""

from __future__ import annotations

import canopen
import pytest

from hil_drivers.cia402.bus import Emergency
from hil_drivers.cia402.objects import (
    ABORTS,
    ERROR_RANGES,
    ERRORS,
    abort_text,
    error_text,
    register_text,
)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8611, "following error"),
        (0x8130, "heartbeat of the master lost"),
        (0x2312, "over-current at the output"),  # by FFF0h
        (0x23F0, "current at the output"),  # by FF00h
        (0x7777, "additional modules"),  # by F000h
        (0xFF42, "vendor's own error"),
        (0x0000, "no error"),
        (0xA000, "unknown error"),
    ],
)
def test_a_code_is_told_by_its_own_text_or_by_the_narrowest_range(code, text):
    assert error_text(code) == f"{text} ({code:04X}h)"


def test_ranges_are_asked_from_narrow_to_wide():
    widths = [mask.bit_count() for mask, _, _ in ERROR_RANGES]
    assert widths == sorted(widths, reverse=True)
    assert all(kept & mask == kept for mask, kept, _ in ERROR_RANGES)


@pytest.mark.parametrize("code", sorted(ERRORS))
def test_every_text_is_found_by_its_code(code):
    assert error_text(code).startswith(ERRORS[code])


def test_the_register_is_told_bit_by_bit():
    assert register_text(0x21) == "generic, device profile"
    assert register_text(0x00) == ""


def test_an_emergency_says_code_register_and_the_makers_data():
    emergency = Emergency(2, 0x8611, 0x21, b"\x01\x00\x00\x00\xff")
    assert str(emergency) == (
        "following error (8611h); error register: generic, device profile, data 01 00 00 00 ff"
    )
    assert str(Emergency(2, 0x3220, 0, bytes(5))) == "DC link under-voltage (3220h)"
    assert str(Emergency(2, 0, 0, bytes(5))) == "errors are gone (0000h)"


def test_abort_codes_are_told_with_the_number_as_manuals_write_it():
    assert abort_text(0x06040041) == "cannot be mapped into a PDO (abort 0604 0041h)"
    assert abort_text(0x0BAD0001) == "abort 0BAD 0001h"


def test_every_abort_that_canopen_knows_has_a_text_of_ours():
    assert set(canopen.SdoAbortedError.CODES) <= set(ABORTS)
