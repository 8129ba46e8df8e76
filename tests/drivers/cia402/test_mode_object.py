"""The mode by object, where the process data do not carry it."""

from __future__ import annotations

import pytest

from hil.core.errors import CommandRefused
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.commissioning import set_mode
from hil_drivers.cia402.mapping import MAPPINGS


class Modes:
    """Drives that show a mode after some looks; one stays where it is."""

    def __init__(self, shows, stuck=()):
        self.shows, self.stuck, self.looks = list(shows), stuck, 0
        self.written = [0] * len(self.shows)

    def name_of(self, axis):
        return f"joint_{axis + 1}"

    def upload(self, axis, entry):
        assert entry == od.MODE_DISPLAY
        self.looks += 1
        if self.looks > 3 and axis not in self.stuck:
            self.shows[axis] = self.written[axis]
        return self.shows[axis]

    def download(self, axis, entry, value):
        assert entry == od.MODE
        self.written[axis] = value


def test_only_the_minimal_mapping_lacks_the_mode():
    assert {name for name, mapping in MAPPINGS.items() if not mapping.carries_mode} == {"minimal"}


def test_a_mode_that_was_left_in_the_drives_is_replaced_and_waited_for():
    modes = Modes([od.CST, od.CST])
    set_mode(modes, range(2), od.CSP)
    assert modes.written == modes.shows == [od.CSP, od.CSP]


def test_a_drive_that_stays_in_its_mode_is_named_with_it():
    modes = Modes([od.CST, od.CST], stuck=(1,))
    with pytest.raises(CommandRefused, match=r"joint_2: mode 8 \(csp\).* shows 10 \(cst\)"):
        set_mode(modes, range(2), od.CSP, within_s=0.05)
