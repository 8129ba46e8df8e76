"""A model judged under a load that it was not fitted with, as `hil fit --validate` prints it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.cli.fit import print_under_load
from hil.core.errors import FitError
from hil.data.dataset import Dataset
from hil.estimators.rigid_linear import RigidWls
from hil.evaluation import evaluate
from hil.evaluation.validation import UnderLoad, under_load
from tests.support.load_parts import OFF_AXIS, recorded
from tests.support.synthetic_motion import nominal, raw

BARE = [Payload()]
LOAD = OFF_AXIS[1]
TURNED = replace(LOAD, com=(-LOAD.com[0], -LOAD.com[1], LOAD.com[2]))


@cache
def model() -> RigidWls:
    return RigidWls().fit(recorded(1, 1, 2, 3), nominal())


@cache
def loaded(declared: Payload = LOAD) -> Dataset:
    data = raw(recorded(1, 5, 6, load=LOAD))
    return replace(data, conditions=tuple(replace(c, payload=declared) for c in data.conditions))


@pytest.fixture(scope="module", autouse=True)
def identified_once() -> Iterator[None]:
    """Whatever is declared, the same load is identified from the same motion: once in here."""
    from hil.evaluation import validation

    def remembering(real: Callable[..., Any]) -> Callable[..., Any]:
        known: dict[tuple[object, ...], Any] = {}

        def call(model: Any, data: Dataset, **options: Any) -> Any:
            samples = (data[name].tobytes() for name in ("q", "effort"))
            key = (model, repr(options), *samples)
            if key not in known:
                known[key] = real(model, data, **options)
            return known[key]

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ("estimate_payload", "payload_halves"):
            patch.setattr(validation, name, remembering(getattr(validation, name)))
        yield


@cache
def found(declared: Payload = LOAD) -> UnderLoad:
    result = under_load(model(), loaded(declared), BARE)
    assert result is not None
    return result


def means(of: UnderLoad) -> dict[str, float]:
    return {told: float(np.mean(error)) for told, error in of.rmse.items()}


@pytest.mark.thorough
def test_told_of_the_load_a_model_errs_far_less() -> None:
    mean = means(found())
    assert set(mean) == {"unaware", "declared", "identified"}
    assert max(mean["declared"], mean["identified"]) < 0.5 * mean["unaware"]


@pytest.mark.thorough
def test_told_as_declared_it_errs_as_the_validation_says() -> None:
    errors = evaluate(model(), loaded()).total.rmse_filtered
    assert found().rmse["declared"] == pytest.approx(errors)


@pytest.mark.thorough
def test_a_correct_declaration_agrees_and_a_turned_tool_is_named() -> None:
    assert found().check is not None
    assert found().check.agrees
    wrong = found(TURNED)
    assert "turned by" in wrong.to_dict()["contradictions"][0]
    assert means(wrong)["declared"] > 2 * means(wrong)["identified"]
    assert means(wrong)["identified"] == pytest.approx(means(found())["identified"], rel=1e-3)


@pytest.mark.thorough
def test_no_half_is_judged_with_what_it_told_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    from hil.evaluation import validation

    real = validation.payload_halves

    def spoilt(*of: Any) -> Any:
        first, second = real(*of)
        return replace(first, estimate=replace(first.estimate, payload=Payload())), second

    monkeypatch.setattr(validation, "payload_halves", spoilt)
    data = loaded()
    first, _ = validation.halves(data)
    effort = validation._by_halves(model(), data)
    error = np.abs(data["effort"] - effort)
    # What the first half told is spoilt: only the second, which is predicted with it, suffers.
    assert np.mean(error[~first]) > 3 * np.mean(error[first])


@pytest.mark.thorough
def test_there_is_nothing_to_judge_where_the_load_is_known_several_or_at_rest() -> None:
    assert under_load(model(), loaded(), [LOAD]) is None
    bare = raw(recorded(1, 5, 6))
    assert under_load(model(), bare, BARE) is None
    assert under_load(model(), bare, None) is None
    assert under_load(model(), Dataset.concatenate([loaded(), loaded(TURNED)]), BARE) is None
    still = tuple(replace(c, kind="dwell") for c in loaded().conditions)
    assert under_load(model(), replace(loaded(), conditions=still), BARE) is None


@pytest.mark.thorough
@pytest.mark.parametrize("known", [BARE, None])
def test_a_load_that_nobody_declared_is_found(
    known: list[Payload] | None, capsys: pytest.CaptureFixture[str]
) -> None:
    result = under_load(model(), loaded(Payload()), known)
    assert result is not None
    print_under_load(json.loads(json.dumps(result.to_dict())))
    text = capsys.readouterr().out
    assert text.startswith("with no payload declared\n")
    assert "CONTRADICTED: " in text
    assert "kg heavier than declared" in text


@pytest.mark.thorough
def test_a_wrong_declaration_is_found_although_the_model_was_fitted_with_it() -> None:
    result = under_load(model(), loaded(TURNED), [TURNED])
    assert result is not None
    assert result.new is False
    assert "turned by" in result.to_dict()["contradictions"][0]


@pytest.mark.thorough
def test_what_gains_may_explain_is_neither_contradicted_nor_confirmed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lighter = replace(LOAD, mass=LOAD.mass - 0.4)
    told = json.loads(json.dumps(found(lighter).to_dict()))
    assert told["agrees"]
    assert 0.25 < told["mass_limit_kg"] < 0.7
    print_under_load(told)
    text = capsys.readouterr().out
    assert "neither contradicted nor confirmed. With exact drive gains: 0.3" in text
    assert "kg heavier than declared" in text
    assert f"can explain ±{told['mass_limit_kg']:.2f} kg" in text
    assert "agrees with the identified load" not in text


def test_a_load_that_does_not_show_leaves_the_other_errors(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hil.evaluation import validation

    def failing(*of: Any) -> Any:
        raise FitError("the payload estimate did not converge")

    monkeypatch.setattr(validation, "estimate_payload", failing)
    result = under_load(model(), loaded(), BARE)
    assert result is not None
    assert set(result.rmse) == {"unaware", "declared"}
    print_under_load(json.loads(json.dumps(result.to_dict())))
    assert "not identified: the payload estimate did not converge" in capsys.readouterr().out


@pytest.mark.thorough
def test_the_terminal_shows_three_errors_and_the_verdict(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_under_load(json.loads(json.dumps(found().to_dict())))
    lines = capsys.readouterr().out.splitlines()
    assert "3.000 kg at (-0.030, 0.055, 0.045) m declared" in lines[0]
    assert [line.split()[0] for line in lines[2:5]] == ["unaware", "declared", "identified"]
    assert lines[3].split()[-1] == f"{means(found())['declared']:.4f}"
    assert "agrees" in lines[-1]
    print_under_load(json.loads(json.dumps(found(TURNED).to_dict())))
    assert "CONTRADICTED: turned by" in capsys.readouterr().out
