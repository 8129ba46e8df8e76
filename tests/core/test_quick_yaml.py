"""YAML that is only looked at."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from hil.arms import load_arm
from hil.cli import completion
from hil.core.errors import SpecError
from hil.core.yaml import DEEPEST_LOOK, as_scalar, look_into
from hil.maintenance.fleet_specs import spec_for
from hil_mock_robot.ur.faults import UrFault

LINKED = "- &a0 [x]\n" + "".join(f"- &a{i} [*a{i - 1}]\n" for i in range(1, 200))
LAUGHS = "a0: &a0 {k: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    "text",
    [
        "a: [1", b"a: \xff", "!!python/object/apply:os.getcwd []", "a: \x00", "a: \ud800",
        '!!int ""', "!!bool x", "!!timestamp x", "a: 2020-02-30", "[a]: 1", "=", "[" * 5000,
        "- " * 5000, LINKED, LAUGHS, "&a [*a]",
    ],
)  # fmt: skip
def test_what_is_no_document_is_one_kind_of_error(text: str | bytes) -> None:
    for compiled in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            if not compiled:
                patch.delattr(yaml, "CSafeLoader", raising=False)
            with pytest.raises(ValueError, match="YAML"):
                look_into(text)


def test_brackets_without_end_do_not_end_the_process() -> None:
    code = (
        "from hil.core.yaml import look_into\n"
        "for text in ('[' * 60000, '[' * 60000 + ']' * 60000, '{a: ' * 60000, '- ' * 60000):\n"
        "    try: look_into(text)\n"
        "    except ValueError as error: assert 'more than 100 levels' in str(error), error\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_people_write_is_read() -> None:
    assert look_into("a: &a [1]\nb: *a\nc: {<<: {d: 2}}") == {"a": [1], "b": [1], "c": {"d": 2}}
    deep = look_into("[" * DEEPEST_LOOK + "]" * DEEPEST_LOOK)
    assert str(deep) == "[" * DEEPEST_LOOK + "]" * DEEPEST_LOOK


def test_files_from_elsewhere_are_refused_however_deep(tmp_path: Path) -> None:
    deep = tmp_path / "deep.yaml"
    deep.write_text("[" * 5000)
    said = r"deep\.yaml: .*more than 100 levels"
    with pytest.raises(SpecError, match=said):
        load_arm(str(deep))
    with pytest.raises(SpecError, match=said):
        UrFault.read(deep)
    with pytest.raises(SpecError, match=said):
        spec_for(deep.read_text(), str(deep), "ur5")
    assert as_scalar("[" * 5000).startswith('"[')


def test_robots_of_a_station_that_is_none_are_not_offered(tmp_path: Path) -> None:
    station = tmp_path / "station.yaml"
    station.write_bytes(b"robots: {one: 1}")
    context = SimpleNamespace(params={"station": station})
    complete = completion._completion_of(completion.BY_NAME["robot"])
    assert complete(context, "") == ["one"]
    station.write_bytes(b"robots: {\xff: 1}")
    assert complete(context, "") == []
