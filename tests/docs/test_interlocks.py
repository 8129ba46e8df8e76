"""What the pages about interlocks show is true: specs, plug-in, table of kinds."""

from __future__ import annotations

import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from hil.core import plugins
from hil.engine.interlocks import InterlockContext, interlocks_from_spec
from hil.spec import spec_from_text
from hil.spec.interlocks import DEFAULTS, INTERLOCK_KINDS
from hil.spec.model_tree import kinds_of
from tests.support.engine_parts import ListSink, engine
from tests.support.interlock_parts import NAMES, rows
from tests.support.kinematic_robot import KinematicRobot
from tests.support.paths import DOCS

REFERENCE = (DOCS / "reference" / "interlocks.md").read_text("utf-8")
HOW_TO = (DOCS / "how-to" / "add-an-interlock.md").read_text("utf-8")
HEAD = "hil: 1\nname: demo\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 20}\n"
ROWS = dict(re.findall(r"^\| `(\w+)` \|(.*)$", REFERENCE, re.MULTILINE)[1:])


def block(page: str, language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)
    return str(found)


def test_the_list_shown_is_a_list_of_interlocks() -> None:
    spec = spec_from_text(HEAD + block(REFERENCE, "yaml"))
    listed = block(REFERENCE, "yaml").count("kind:")
    assert len(spec.interlocks) > listed


def test_the_table_lists_every_kind_with_its_keys_and_actions() -> None:
    assert tuple(ROWS) == INTERLOCK_KINDS
    models = kinds_of(type(spec_from_text(HEAD)).model_fields["interlocks"].annotation.__args__[0])
    for kind, row in ROWS.items():
        own = set(models[kind].model_fields) - {"kind", "action", "enabled", "resume_below_c"}
        assert {key for key in re.findall(r"`(\w+)`", row) if key != "clearance_m"} == own
        pauses = "pause" in str(models[kind].model_fields["action"].annotation)
        assert row.endswith("| stop, pause |" if pauses else "| stop |")


def test_the_table_says_which_are_in_every_run() -> None:
    never = {kind for kind, row in ROWS.items() if row.split("|")[-3].strip() == "–"}
    assert set(INTERLOCK_KINDS) - never == {default.kind for default in DEFAULTS}


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "power.py").write_text(block(HOW_TO, "python"))
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("my_package", "my_package.power"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (group, name, target) = re.findall(
        r'entry-points\."([\w.]+)"\]\n(\w+) = "(.+?)"', block(HOW_TO, "toml")
    )[0]
    point = EntryPoint(name, target, group)
    monkeypatch.setattr(
        plugins, "entry_points", lambda *, group: [point] if group == point.group else []
    )


@pytest.mark.usefixtures("plugged")
def test_the_plug_in_shown_trips() -> None:
    spec = spec_from_text(HEAD + block(HOW_TO, "yaml"))
    context = InterlockContext(joint_names=NAMES, drive_gains=(10.0,) * 6)
    (power,) = (
        one for one in interlocks_from_spec(spec.interlocks, context) if one.name == "power"
    )
    assert power.check(rows(effort=5.0, qd=2.0)) is None
    trip = power.check(rows(effort=5.0, qd=-3.1))
    assert trip is not None
    assert trip.text(NAMES).startswith("interlock power: j1 at 155 W, limit 150 W")
    assert power.check(rows(effort=np.nan)) is not None
    assert not power.clear(rows(effort=5.0, qd=2.9))
    result = engine(KinematicRobot(), ListSink(), interlocks=[power]).run()
    assert result.error is None
