"""YAML that is only looked at."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hil.cli import candidates
from hil.quick_yaml import look_into


@pytest.mark.parametrize(
    "text",
    ["a: [1", b"a: \xff", "!!python/object/apply:os.getcwd []", "[" * 5000, "a: \x00"],
    ids=["torn", "not UTF-8", "code", "deep", "a NUL"],
)
def test_what_is_no_document_is_one_kind_of_error(text: str | bytes, tmp_path: Path) -> None:
    for compiled in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            if not compiled:
                patch.delattr(yaml, "CSafeLoader", raising=False)
            with pytest.raises(ValueError, match="YAML"):
                look_into(text)


def test_robots_of_a_station_that_is_none_are_not_offered(tmp_path: Path) -> None:
    station = tmp_path / "station.yaml"
    station.write_bytes(b"robots: {one: 1}")
    assert candidates.robots({"station": station}, "") == ["one"]
    station.write_bytes(b"robots: {\xff: 1}")
    assert candidates.robots({"station": station}, "") == []
