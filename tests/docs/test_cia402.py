"""The pages on options and objects of CiA 402 drives name all there are, as they are."""

from __future__ import annotations

import dataclasses
import re

import pytest
import yaml

from hil_drivers.cia402 import axis, can_channel, commissioning, objects, options
from hil_drivers.cia402.bus import Setting
from hil_drivers.cia402.can_bus import CanopenAcyclic
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import Options, options_of
from hil_drivers.cia402.profile import COUNTS_PER_REV_S, PROFILES
from tests.support.paths import ROOT

REFERENCE = ROOT / "docs/reference"
OPTIONS = (REFERENCE / "cia402-options.md").read_text("utf-8")
OBJECTS = (REFERENCE / "cia402-objects.md").read_text("utf-8")


def rows(page: str) -> dict[str, list[str]]:
    """Rows of all tables by their first cell."""
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines()]
    return {row[0]: row[1:] for row in table if len(row) > 1}


def test_every_option_is_there_with_its_default():
    told = {name.strip("`"): row[0].strip("`") for name, row in rows(OPTIONS).items()}
    defaults = {f.name: f.default for f in dataclasses.fields(Options)}
    assert set(defaults) <= set(told)
    for name in ("master_id", "trajectory_mode", "effort", "stop_rad_s2", "profile", "late_cycles"):
        assert told[name] == f"{defaults[name]:g}" if name == "stop_rad_s2" else str(defaults[name])
    assert float(told["following_error_deg"]) == defaults["following_error_deg"]
    assert float(told["pace"]) == defaults["pace"]


def test_every_key_of_an_axis_unit_and_profile_is_named():
    named = set(re.findall(r"`([^`\n]+)`", OPTIONS))
    assert set(options.AXIS_KEYS) | set(COUNTS_PER_REV_S) | set(PROFILES) <= named
    for name, settings in PROFILES.items():
        assert all(key in rows(OPTIONS)[f"`{name}`"][0] for key in settings)


def test_the_station_that_is_shown_can_be_used():
    block = re.search(r"```yaml\n(.*?)```", OPTIONS, re.S)
    assert block is not None
    robot = yaml.safe_load(block[1])["robots"]["arm"]
    told = options_of(robot["options"], robot["model"])
    assert told.axes[1]["direction"] == -1


@pytest.mark.parametrize("name", sorted(MAPPINGS))
def test_the_table_of_bus_loads_is_what_is_computed(name):
    mapping, cells = MAPPINGS[name], rows(OPTIONS)[f"`{name}`"]
    load = can_channel.load_of(mapping, 6, 250.0, 1e6).cyclic
    rates = [round(can_channel.most_rate_hz(mapping, 6, bits)) for bits in (1e6, 5e5)]
    assert cells[1:] == [
        str(len(can_channel.cycle_lengths(mapping, 6))),
        f"{100 * load.nominal:.0f} to {100 * load.worst:.0f} %",
        *(f"{rate} Hz" for rate in rates),
    ]


def settings() -> list[Setting]:
    given = options_of(_BUS, "lab6")
    return CanopenAcyclic.settings(given, commissioning.settings_of(given, _AXIS))


def test_every_object_that_is_asked_or_set_or_mapped_is_named():
    entries = {*commissioning.ASKED, *(each.entry for each in settings())}
    entries |= {e for m in MAPPINGS.values() for pdo in m.pdos for e in pdo.entries}
    entries |= {e for more in commissioning.ASKED_TOO.values() for e in more}
    entries |= {objects.ERROR_COUNT, objects.PRODUCER_HEARTBEAT, objects.ERROR_REGISTER}
    assert [str(e) for e in entries if f"{e.index:04X}h" not in OBJECTS] == []


def test_what_a_drive_can_do_without_is_told_as_such():
    told = {cell.split(":")[0].split(",")[0]: row[-1] for cell, row in rows(OBJECTS).items()}
    for setting in settings():
        without = told[f"{setting.entry.index:04X}h"]
        assert without == ("refused" if setting.needed else "goes on"), str(setting.entry)


def test_the_mappings_carry_what_the_table_says():
    for name, mapping in MAPPINGS.items():
        told = rows(OBJECTS)[f"`{name}`"]
        carried = [" ".join(f"{e.index:04X}h" for e in pdo.entries) for pdo in mapping.rpdos]
        carried += ["–"] * (2 - len(carried))
        carried += [" ".join(f"{e.index:04X}h" for e in pdo.entries) for pdo in mapping.tpdos]
        assert told == carried + ["–"] * (4 - len(carried))


def test_the_table_of_states_is_what_is_sent():
    table = [line.strip("|").split("|") for line in OBJECTS.splitlines() if line.startswith("|")]
    names = {state.value for state in axis.State}
    shown = [row for row in table if len(row) == 5 and row[2].strip() in names]
    assert len(shown) == len(axis.State) - 1
    for six, four, name, enabling, switching_off in shown:
        state = axis.state_of(int((six.strip() or four.strip()).rstrip("h"), 16))
        assert state.value == name.strip()
        for goal, cell in ((axis.Goal.ENABLED, enabling), (axis.Goal.OFF, switching_off)):
            word = int(cell.strip()[:2], 16)
            assert axis.controlword_towards(state, goal) == word, (name, goal)


_BUS = {"bus": {"interface": "hil_unix", "channel": "can0"}, "torque_limit_percent": 100}
_AXIS = commissioning.axis_profile(
    "generic",
    {"gear_ratio": 100.0},
    {"encoder_increments": 1 << 20, "rated_current_a": 1.0, "rated_torque_nm": 1.0},
)
