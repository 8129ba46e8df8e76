"""The page about what the UR driver records names every field, with its type and unit."""

from __future__ import annotations

import re

from hil_drivers.ur.rtde import FIELDS
from hil_drivers.ur.state import EFFORTS, further_topic, ros_name
from tests.support.paths import ROOT

PAGE = (ROOT / "docs/reference/ur-driver-fields.md").read_text("utf-8")


def rows() -> list[list[str]]:
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in PAGE.splitlines()]


def test_every_field_of_the_topic_is_there_with_output_type_and_unit():
    told = {row[0]: row[1:4] for row in rows() if len(row) == 5}
    kept = set(further_topic(125.0).dtype.names[2:])
    expected = {
        ros_name(f.name): [f.name, f.type, f.unit] for f in FIELDS if ros_name(f.name) in kept
    }
    assert {name: told.get(name) for name in expected} == expected
    assert kept == set(expected)


def test_every_output_and_torque_source_is_named():
    named = set(re.findall(r"`([A-Za-z0-9_-]+)`", PAGE))
    assert {field.name for field in FIELDS} <= named
    assert set(EFFORTS) <= named
