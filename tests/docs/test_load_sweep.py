"""What the page about load sweeps shows can be run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hil.core.errors import SpecError
from hil.spec.experiment import Weigh
from hil.spec.load import load_spec
from tests.support.paths import DOCS, EXPERIMENTS

PAGE = (DOCS / "how-to" / "load-sweep.md").read_text("utf-8")
SHIPPED = (EXPERIMENTS / "ur5_fourier_loads.yaml").read_text("utf-8")
LOADS, WEIGH, UNDER = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
HOLD_OUTS = re.findall(r"^\| `(\{.+?\})` \|", PAGE, re.MULTILINE)


def spec_with(hold_out: str, tmp_path: Path) -> Path:
    text = re.sub(r"(?ms)^loads:.*?\n\n", LOADS + "\n", SHIPPED)
    text = re.sub(r"hold_out: \{.*?\}", f"hold_out: {hold_out}", text)
    path = tmp_path / "sweep.yaml"
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("hold_out", HOLD_OUTS)
def test_every_way_to_hold_out_shown_is_accepted(hold_out: str, tmp_path: Path) -> None:
    spec = load_spec(spec_with(hold_out, tmp_path))
    assert [load.mass_kg for load in spec.loads] == [0, 1.5, 3]


def test_loads_are_counted_from_zero(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="there is no load 3"):
        load_spec(spec_with("{loads: [3]}", tmp_path))


def test_three_ways_are_shown() -> None:
    assert len(HOLD_OUTS) == 3


def test_the_way_of_weighing_shown_is_the_default(tmp_path: Path) -> None:
    path = tmp_path / "weighed.yaml"
    path.write_text(SHIPPED + WEIGH, "utf-8")
    assert load_spec(path).weigh == Weigh()


def test_judging_under_loads_as_shown_is_accepted(tmp_path: Path) -> None:
    text = re.sub(r"(?ms)^(fit|validate|accept):.*?(?=^\S|\Z)", "", SHIPPED)
    path = tmp_path / "under.yaml"
    path.write_text(f"{text}\n{UNDER}", "utf-8")
    spec = load_spec(path)
    assert spec.hold_out.loads == (1,)
    assert [key for key in spec.accept.under_loads if f"`{key}`" in PAGE] == [
        "load_error_ratio",
        "contradicted_loads",
    ]
