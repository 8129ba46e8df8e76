"""Stages are done once for what they are made from, in the order of their needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RecordingError
from hil.maintenance.stages import FOLDER, Document, Stage, run_stages, stored_result


class Work:
    """Three stages, one after the other; notes which of them are done."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.inputs: dict[str, dict[str, Any]] = {"a": {}, "b": {}, "c": {}}

    def stages(self) -> list[Stage]:
        return [
            Stage("c", self._do("c"), ("b",), self.inputs["c"]),
            Stage("b", self._do("b"), ("a",), self.inputs["b"]),
            Stage("a", self._do("a"), (), self.inputs["a"]),
        ]

    def _do(self, name: str) -> Any:
        def do(before: Mapping[str, Document]) -> Document:
            self.done.append(name)
            return {"name": name, "before": {key: one["name"] for key, one in before.items()}}

        return do


@pytest.fixture
def work() -> Work:
    return Work()


def test_stages_are_done_in_the_order_of_needs_and_see_what_they_need(work, tmp_path) -> None:
    told = run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c"]
    assert told["c"] == {"name": "c", "before": {"b": "b"}}
    assert stored_result(tmp_path, "c") == told["c"]


def test_what_is_done_is_not_done_again(work, tmp_path) -> None:
    first = run_stages(work.stages(), tmp_path)
    assert run_stages(work.stages(), tmp_path) == first
    assert work.done == ["a", "b", "c"]


def test_other_inputs_make_a_stage_and_all_after_it_anew(work, tmp_path) -> None:
    run_stages(work.stages(), tmp_path)
    work.inputs["b"] = {"share": 0.1}
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c", "b", "c"]


def test_a_file_counts_with_its_content(work, tmp_path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text("one", "utf-8")
    work.inputs["c"] = {"spec": file}
    run_stages(work.stages(), tmp_path)
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c"]
    file.write_text("two", "utf-8")
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c", "c"]


@pytest.mark.parametrize("damage", ["torn", "changed", "no JSON"])
def test_a_damaged_document_is_made_anew(work, tmp_path, damage) -> None:
    told = run_stages(work.stages(), tmp_path)
    path = tmp_path / FOLDER / "b.json"
    text = path.read_text("utf-8")
    changed = text.replace('"name": "b"', '"name": "x"')
    damaged = {"torn": text[:-20], "changed": changed, "no JSON": "[]"}
    path.write_text(damaged[damage], "utf-8")
    assert stored_result(tmp_path, "b") is None
    assert run_stages(work.stages(), tmp_path) == told
    # It comes to the same, so that nothing after it is touched.
    assert work.done == ["a", "b", "c", "b"]


def test_a_stage_that_fails_leaves_those_before_it(work, tmp_path) -> None:
    def fails(before: Mapping[str, Document]) -> Document:
        raise DataError("nothing there")

    stages = [*work.stages(), Stage("d", fails, ("c",))]
    for _ in range(2):
        with pytest.raises(DataError, match="nothing there"):
            run_stages(stages, tmp_path)
    assert work.done == ["a", "b", "c"]


def test_a_document_is_the_same_the_first_time_as_read_back(tmp_path) -> None:
    def do(before: Mapping[str, Document]) -> Document:
        return {"tuple": (1, 2), "nan": float("nan"), "path": Path("x"), 3: "three"}

    first = run_stages([Stage("a", do)], tmp_path)
    assert first == run_stages([Stage("a", do)], tmp_path)
    assert first["a"] == {"tuple": [1, 2], "nan": None, "path": "x", "3": "three"}
    assert json.loads((tmp_path / FOLDER / "a.json").read_bytes())["stage"] == "a"


def test_needs_that_cannot_be_are_refused(work, tmp_path) -> None:
    with pytest.raises(ValueError, match="there is no stage a"):
        run_stages(work.stages()[:2], tmp_path)
    around = [Stage("a", dict, ("b",)), Stage("b", dict, ("a",))]
    with pytest.raises(ValueError, match="stages need each other: "):
        run_stages(around, tmp_path)
    with pytest.raises(ValueError, match="same name"):
        run_stages([Stage("a", dict), Stage("a", dict)], tmp_path)


def test_a_folder_that_cannot_be_written_is_told(work, tmp_path) -> None:
    (tmp_path / FOLDER).write_text("in the way", "utf-8")
    with pytest.raises(RecordingError, match="cannot write"):
        run_stages(work.stages(), tmp_path)
