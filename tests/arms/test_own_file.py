"""The digest of an arm of one's own: what makes the arm counts, remarks do not."""

from __future__ import annotations

from hashlib import sha256
from importlib.resources import files
from pathlib import Path

import pytest

from hil.arms import load_arm, model_sha256, require_same_arm
from hil.arms.description import _parsed
from hil.core.errors import DataError, SpecError
from tests.support.paths import FILES

URDF = FILES / "own_arm.urdf"


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    text = files("hil.arms").joinpath("ur5.yaml").read_text("utf-8")
    path = tmp_path / "own.yaml"
    path.write_text(f"guessed: [capsules, excite]\n{text}", "utf-8")
    return path


def changed(path: Path, old: str, new: str) -> str:
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), "utf-8")
    return read_anew(path)


def read_anew(path: Path) -> str:
    _parsed.cache_clear()
    return model_sha256(str(path))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("guessed: [capsules, excite]", "guessed: [excite]"),
        ("guessed: [capsules, excite]\n", ""),
        ("# UR5", "# Our UR5"),
        ("the maker's rating", "its plate"),
        ("rate_hz: 125\npayload_max_kg: 5\n", "payload_max_kg: 5.0\nrate_hz: 1.25e+2\n"),
    ],
    ids=["a guess", "no guesses", "a comment", "a source", "order and numerals"],
)
def test_remarks_leave_an_arm_what_it_was(old: str, new: str, arm: Path) -> None:
    before = read_anew(arm)
    assert changed(arm, old, new) == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rate_hz: 125", "rate_hz: 126"),
        ("payload_max_kg: 5", "payload_max_kg: 5.1"),
        ("radius_m: 0.", "radius_m: 0.1"),
        ("shoulder_pan_joint", "shoulder_joint"),
        ("mass_kg: ", "mass_kg: 1"),
    ],
)
def test_what_makes_an_arm_another_one_counts(old: str, new: str, arm: Path) -> None:
    before = read_anew(arm)
    assert changed(arm, old, new) != before


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("of nobody's", "of ours", True),
        ('<link name="base"/>', '<link name="base"><visual/></link>', True),
        ('"turret"><inertial>', '"turret">\n  <inertial>', True),
        ('<mass value="9"/>', '<mass value="9.5"/>', False),
    ],
    ids=["a comment", "looks", "white space", "a mass"],
)
def test_of_a_urdf_joints_and_inertias_count(
    old: str, new: str, same: bool, tmp_path: Path
) -> None:
    path = tmp_path / URDF.name
    path.write_bytes(URDF.read_bytes())
    before = read_anew(path)
    assert (changed(path, old, new) == before) == same


@pytest.mark.parametrize("kind", ["description", "urdf"])
def test_a_run_that_has_the_digest_of_the_bytes_needs_the_same_bytes(
    kind: str, arm: Path, tmp_path: Path
) -> None:
    path = arm
    if kind == "urdf":
        path = tmp_path / URDF.name
        path.write_bytes(URDF.read_bytes())
    earlier = {"model": str(path), "model_sha256": sha256(path.read_bytes()).hexdigest()}
    now = {"model": str(path), "model_sha256": read_anew(path)}
    assert earlier != now
    for recorded in (earlier, now):
        require_same_arm(recorded, Path("run"), "do without")
    changed(path, "# UR5" if kind == "description" else "of nobody's", "# Of ours")
    require_same_arm(now, Path("run"), "do without")
    with pytest.raises(DataError, match="has changed since run was made"):
        require_same_arm(earlier, Path("run"), "do without")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("mass_kg: ", "mass_kg: -", "must not be negative"),
        ("mass_kg: 3.7", "mass_kg: .nan", "must be finite numbers"),
        ("[0.0149724,", "[9.0149724,", "sum of the others"),
    ],
)
def test_links_that_cannot_exist_are_refused(old: str, new: str, problem: str, arm: Path) -> None:
    arm.write_text(arm.read_text("utf-8").replace(old, new, 1), "utf-8")
    with pytest.raises(SpecError, match=problem) as caught:
        load_arm(str(arm))
    assert "shoulder" in caught.value.message


def test_inertias_that_were_rounded_are_possible(arm: Path) -> None:
    """A flat disc in six digits after the point, as CAD programs write it."""
    text = arm.read_text("utf-8")
    disc = "[1.2e-5, 1.2e-5, 2.5e-5, 0, 0, 0]"
    arm.write_text(text.replace("[8.06248e-5, 8.06248e-5, 0.000132117, 0, 0, 0]", disc), "utf-8")
    assert load_arm(str(arm)).inertia[-1][2, 2] == 2.5e-5


def test_a_file_that_is_no_xml_counts_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "torn.urdf"
    path.write_text("<robot", "utf-8")
    assert model_sha256(str(path)) == sha256(b"<robot").hexdigest()
