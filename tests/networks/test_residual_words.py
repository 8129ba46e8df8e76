"""What a residual network that hears torque says of itself beside the trivial observer."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.support.residual_models import known, unfitted
from tests.support.synthetic_motion import moving, nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.data import Dataset

BRIEF = {"epochs": 1, "batch_size": 64, "device": "cpu"}
NOTE = re.compile(r"holding .* measured (.+) ms before .* error of (.+) A on .*, this model (.+)")


def told(data: Dataset, **changed) -> tuple[float, float, float]:
    """The age in the note [ms], the error of holding, and that of the model."""
    made = unfitted(training=BRIEF, margin=0.0, **changed).fit(data, nominal())
    (found,) = filter(None, map(NOTE.fullmatch, made.notes_))
    age, held, ours = map(float, found.groups())
    return age, held, ours


def noisy() -> Dataset:
    """Torque with noise of 1 A as recorded, of which the filter leaves little."""
    data = moving(1, 2, 3, 4, noise_a=1.0)
    return data.with_columns(effort_f=moving(1, 2, 3, 4)["effort"])


@pytest.mark.thorough
def test_a_history_and_the_network_that_hears_it_are_judged_on_the_torque_as_recorded() -> None:
    _, held, ours = told(noisy(), inputs="history", base={"estimator": "rigid-wls"})
    assert ours > 0.95
    assert held > 1.2


def test_the_papers_torque_and_its_network_are_judged_on_the_filtered_torque() -> None:
    _, held, ours = told(noisy(), inputs="measured", base={"estimator": "rigid-wls"})
    assert max(held, ours) < 0.5


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("inputs", "latency_s", "age_ms"),
    [("measured", 0.02, 10.0), ("history", 0.02, 20.0), ("history", 0.012, 20.0)],
)
def test_the_age_told_is_that_of_the_sample_held(inputs, latency_s, age_ms) -> None:
    data = known()
    age, held, _ = told(data, inputs=inputs, latency_s=latency_s)
    lag = round(age_ms / 10.0)
    steps = [data["effort"][rows][lag:] - data["effort"][rows][:-lag] for _, rows in data.slices()]
    assert age == pytest.approx(age_ms)
    assert held == pytest.approx(np.mean(np.sqrt(np.mean(np.concatenate(steps) ** 2, 0))), rel=5e-3)
