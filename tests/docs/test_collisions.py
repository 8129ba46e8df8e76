"""What the page about collisions shows can be run, and its numbers of settings are the code's."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.control.collision_detection import DEBOUNCE_S, FADES_S, GAIN, QUANTILE
from hil.estimators import estimator
from tests.support.paths import DOCS
from tests.support.synthetic_motion import GAINS, moving, nominal

PAGE = (DOCS / "how-to" / "detect-collisions.md").read_text("utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
LOAD = Payload(2.0, (0.0, 0.0, 0.06))
PUSH_NM = np.array([0.0, 0.0, 90.0, 0.0, 0.0, 0.0])


@pytest.fixture
def model():
    return estimator("rigid-wls").fit(moving(1, 2, 3, noise_a=0.1), nominal())


@pytest.mark.thorough
def test_the_examples_do_what_the_page_says(model, monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    model.save(Path(re.findall(r'"(models/.+?)"', EXAMPLES[0])[0]))
    quiet = moving(*range(10, 28), noise_a=0.1, load=LOAD, samples=60)
    monkeypatch.setattr(hil, "dataset", lambda path: quiet)
    data = moving(40, noise_a=0.1, load=LOAD, samples=300)
    effort = data["effort"].copy()
    effort[200:] -= PUSH_NM / GAINS
    names = {"samples": zip(data["t"], data["q"], data["qd"], effort, strict=True)}
    exec(EXAMPLES[0], names)
    (line,) = capsys.readouterr().out.splitlines()
    told = re.fullmatch(r"(2\.\d+) s: elbow_joint pushed with \+(\d+\.\d) N·m", line)
    assert told is not None
    assert 2.0 <= float(told[1]) < 2.1
    exec(EXAMPLES[1], names)
    assert names["detector"].thresholds.false_alarms == 0.1


def test_settings_are_those_of_the_code() -> None:
    assert f"K is {GAIN:g} 1/s" in PAGE
    assert f"for {1e3 * DEBOUNCE_S:g} ms (`debounce_s`)" in PAGE
    assert f"threshold of each joint is {QUANTILE:g} standard deviations" in PAGE
    assert f"some {FADES_S:g} s after a start" in PAGE
