"""Plan documents: every plan comes back equal; what is no plan is refused with the place."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.core.errors import DataError
from hil.core.files import json_document
from hil.planning.plan import Plan, read_plan, require_plan
from tests.support.fuzzing import damaged, examples, quick_folder
from tests.support.random_plans import plans, small_plan


@pytest.mark.thorough
@examples(50)
@given(plans())
def test_every_plan_comes_back_equal_from_its_json_text(plan: Plan) -> None:
    document = plan.to_dict()
    require_plan(document, "plan")
    assert Plan.from_dict(document) == plan
    text = json_document(document)
    again = Plan.from_dict(json.loads(text))
    assert again == plan
    assert again.hash == plan.hash
    assert json_document(again.to_dict()) == text


@examples(15)
@given(plans())
def test_a_plan_file_is_read_back_as_the_plan_that_was_written(plan: Plan) -> None:
    with quick_folder() as folder:
        (folder / "plan.json").write_bytes(json_document(plan.to_dict()))
        assert read_plan(folder / "plan.json") == plan


SMALL = json.loads(json_document(small_plan().to_dict()))


@examples(100)
@given(damaged([SMALL]))
def test_a_damaged_document_is_a_plan_or_refused(document: Any) -> None:
    with quick_folder() as folder:
        path = folder / "plan.json"
        path.write_text(json.dumps(document), "utf-8", errors="surrogatepass")
        try:
            plan = read_plan(path)
        except DataError as refusal:
            told = refusal.message
        else:
            told = str(path)
            assert Plan.from_dict(plan.to_dict()) == plan
            assert all(math.isfinite(plan.step_duration_s(step)) for step in plan)
        assert str(path) in told


@pytest.mark.parametrize("place", [("weigh_dwell",), ("loads", 0, "size_m")], ids=str)
def test_what_is_null_is_not_there(tmp_path: Path, place: tuple[Any, ...]) -> None:
    document = copy.deepcopy(SMALL)
    holder = document
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = None
    (tmp_path / "plan.json").write_text(json.dumps(document))
    assert read_plan(tmp_path / "plan.json") == Plan.from_dict(SMALL)


@examples(40)
@given(
    st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf-8", "ignore"))
)
def test_any_bytes_are_refused(content: bytes) -> None:
    with quick_folder() as folder:
        (folder / "plan.json").write_bytes(content)
        with pytest.raises(DataError):
            read_plan(folder / "plan.json")


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (("rate_hz",), 0, "rate_hz: Input should be greater than or equal to 0.001, not 0"),
        (("rate_hz",), 5e-324, "rate_hz: Input should be greater than or equal to 0.001"),
        (("steps", 1, "motion", "jerk_rad_s3"), 1e308, "motion.jerk_rad_s3: Input should be less"),
        (("rate_hz",), 10**400, "rate_hz:"),
        (("rate_hz",), math.nan, "rate_hz:"),
        (("joint_names", 1), 7, "joint_names.1: Input should be a valid string, not 7"),
        (("joint_names", 1), "joint 1", "joint_names: two joints have the same name"),
        (("steps", 1, "index"), 2, "steps.1.index: must be 1"),
        (("steps", 1, "load"), 9, "steps.1.load: there is no load 9"),
        (("steps", 1, "kind"), "dance", "steps.1.kind:"),
        (("steps", 1, "motion", "goal_rad", 0), "x", "steps.1.motion.goal_rad.0: Input should be"),
        (("steps", 1, "motion", "goal_rad"), [0.0], "steps.1.motion.goal_rad: has 1 entries for 2"),
        (
            ("steps", 1, "motion", "goal_rad", 0),
            1e9,
            "steps.1.motion.kind: the motion would take longer",
        ),
        (("steps", 1, "motion", "kind"), "spline", "steps.1.motion"),
        (("steps", 1, "surprise"), 1, "steps.1.surprise:"),
        (("loads", 0, "mass_kg"), -1.0, "loads.0.mass_kg:"),
        (("dwell", "samples"), 10.0, "dwell.samples:"),
        (("hil_plan",), 2, "was written by a newer hil"),
    ],
    ids=str,
)
def test_refusal_says_where_and_what(
    tmp_path: Path, place: tuple[Any, ...], value: Any, told: str
) -> None:
    document = copy.deepcopy(SMALL)
    holder = document
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = value
    (tmp_path / "plan.json").write_text(json.dumps(document))
    with pytest.raises(DataError) as caught:
        read_plan(tmp_path / "plan.json")
    assert told in caught.value.message
    assert "plan.json" in caught.value.message


def test_everything_that_is_wrong_is_told_at_once(tmp_path: Path) -> None:
    document = copy.deepcopy(SMALL)
    document["rate_hz"] = "fast"
    del document["dwell"]["samples"]
    document["steps"][0]["load"] = None
    (tmp_path / "plan.json").write_text(json.dumps(document))
    with pytest.raises(DataError) as caught:
        read_plan(tmp_path / "plan.json")
    assert all(
        place in caught.value.message for place in ("rate_hz", "dwell.samples", "steps.0.load")
    )


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        read_plan(tmp_path / "plan.json")
