"""The key `weigh`: on by default, off in three spellings, nothing else under it."""

from __future__ import annotations

import pytest

from hil.core.errors import SpecError
from hil.spec.documentation import schema_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.load import spec_from_text

HEAD = "hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: dwell}\n"


def spec(line: str = "") -> ExperimentSpec:
    return spec_from_text(HEAD + line)


def test_loads_are_weighed_at_two_poses_unless_the_spec_says_otherwise() -> None:
    weigh = spec().weigh
    assert weigh is not None
    assert (weigh.poses, weigh.tolerance_kg, weigh.tolerance_percent) == (2, 0.15, 10.0)


@pytest.mark.parametrize("off", ["false", "null", ""])
def test_weighing_can_be_switched_off(off: str) -> None:
    assert spec(f"weigh: {off}\n").weigh is None


def test_no_poses_are_allowed_and_mean_the_same() -> None:
    weigh = spec("weigh: {poses: 0}\n").weigh
    assert weigh is not None
    assert weigh.poses == 0


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("weigh: {tolerance_g: 200}", "use tolerance_kg: 0.2"),
        ("weigh: {pose: 3}", "did you mean 'poses'?"),
        ("weigh: {poses: -1}", "weigh.poses: must be at least 0"),
        ("weigh: {tolerance_kg: 0}", "weigh.tolerance_kg: must be above 0 kg"),
        ("weigh: true", "must be a mapping with keys such as poses"),
        ("weigh: 3", "must be a mapping with keys such as poses"),
    ],
)
def test_slips_are_explained(line: str, told: str) -> None:
    with pytest.raises(SpecError) as refused:
        spec(line + "\n")
    assert told in refused.value.message
    assert len(refused.value.message.splitlines()) == 1


def test_editors_accept_what_is_accepted() -> None:
    allowed = schema_of("experiment")["properties"]["weigh"]["anyOf"]
    assert {"$ref": "#/$defs/Weigh"} in allowed
    assert any(entry.get("const") is False for entry in allowed)
    assert {"type": "null"} in allowed
