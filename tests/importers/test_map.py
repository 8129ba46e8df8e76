"""Import maps: every mistake at its place, and the shipped maps are valid."""

import pytest

from hil.core.errors import SpecError
from hil.importers import load_map
from tests.support.paths import EXPERIMENTS

MAPS = sorted((EXPERIMENTS / "maps").glob("*.yaml"))

GOOD = """\
hil_map: 1
format: csv
robot: ur5
joint_names: [a, b]
effort_kind: current
columns:
  t: {columns: 1, unit: s}
  q: {columns: "2:3", unit: rad}
  effort: {columns: "4:5", unit: A}
"""


def refused(tmp_path, old, new):
    path = tmp_path / "map.yaml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(SpecError) as caught:
        load_map(path)
    return caught.value.message


@pytest.mark.parametrize("path", MAPS, ids=lambda path: path.stem)
def test_shipped_maps_are_valid(path) -> None:
    assert load_map(path).description


def test_good_map_is_read(tmp_path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(GOOD)
    assert load_map(path).columns.q.columns == (2, 3)


def test_unknown_key_is_refused_at_its_line_with_a_guess(tmp_path) -> None:
    message = refused(tmp_path, "robot: ur5", "robot: ur5\ndelimeter: ';'")
    assert "map.yaml:4:1: delimeter: unknown key; did you mean 'delimiter'?" in message


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("unit: rad", "unit: A", "8:"),
        ("unit: rad", "unit: furlong", "'furlong' is not a unit of q"),
        ("unit: A", "unit: N·m", "is a torque, but effort_kind is current"),
        ("effort_kind: current", "effort_kind: current\ndrive_gains_nm_a: [1, 2, 3]", "needs 2"),
        ("unit: rad}", "unit: rad, scale: [1, 2, 3]}", "one value or 2"),
        ("unit: rad}", "unit: rad, matrix: [[1, 0]]}", "must be 2 × 2"),
        ("format: csv", "format: xls", "must be one of"),
        ('  q: {columns: "2:3", unit: rad}\n', "", "is missing"),
        ("unit: rad}", "unit: rad, optional: true}", "cannot be optional"),
        ("hil_map: 1", "hil_map: 2", "hil_map"),
    ],
)
def test_mistakes_are_told_in_plain_words(tmp_path, old, new, expected) -> None:
    assert expected in refused(tmp_path, old, new)


def test_other_yaml_files_are_no_maps(tmp_path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text("hil: 1\n")
    with pytest.raises(SpecError, match="begins with `hil_map: 1`"):
        load_map(path)
