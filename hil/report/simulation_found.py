"""What the weeks of a simulation show: changes seen or not, promotions, errors before and after."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.report.words import UNKNOWN, listed, number

Document = Mapping[str, Any]

BACK = 1.1
"""Error, as a share of the first probe's, that counts as the same again: of all joints in the mean,
and of each joint that has worn, beyond what wear does to what no model knows of its friction."""


@dataclass(frozen=True, slots=True)
class Criterion:
    """Something that should be so.

    Attributes:
        asked: In words.
        met: Whether it is.
        found: What is.
    """

    asked: str
    met: bool
    found: str


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What the weeks show.

    Attributes:
        joints: Names.
        weeks: Of `errors`; a week in which a challenger was promoted is there twice.
        errors: (P, n) RMSE of the champion of that moment on the week's probe.
        level: (n,) of the first probe.
        first_week: When that was.
        promoted: Weeks.
        after: (n,) errors as shares of `level`, mean over the probes after the last change's
            promotion; NaN where there are none.
        criteria: What should be so.
        sentences: The whole in words.
    """

    joints: tuple[str, ...]
    weeks: tuple[float, ...]
    errors: FloatArray
    level: FloatArray
    first_week: float
    promoted: tuple[float, ...]
    after: FloatArray
    criteria: tuple[Criterion, ...]
    sentences: tuple[str, ...]

    def share_of(self, occasion: Document) -> str:
        """Mean error of an occasion's probe as a share of the first one's, in percent."""
        errors = _errors(occasion)
        if errors is None:
            return UNKNOWN
        return f"{100 * float(np.mean(np.array(errors['before']) / self.level)):.0f}"


def found(told: Document) -> Found:
    """Look through a simulation's document."""
    occasions = told["occasions"]
    rows = [row for each in occasions for row in _rows(each)]
    known = next((errors for each in occasions if (errors := _errors(each))), None)
    joints = tuple(known["joint_names"]) if known else ()
    errors = np.array([row for _, row in rows]).reshape(len(rows), len(joints))
    level = errors[0] if len(errors) else np.empty(0)
    promoted = tuple(float(each["week"]) for each in occasions if _is(each, "promoted"))
    weeks = tuple(week for week, _ in rows)
    after = _after(told, weeks, errors, promoted)
    criteria = (*_criteria(told, occasions), *_back(told, after))
    return Found(
        joints, weeks, errors, level, weeks[0] if weeks else float("nan"), promoted, after,
        criteria, tuple(_sentences(told, after)),
    )  # fmt: skip


def _errors(occasion: Document) -> Any:
    return occasion["result"] and occasion["result"]["errors"]


def _rows(occasion: Document) -> list[tuple[float, list[float]]]:
    errors = _errors(occasion)
    if errors is None:
        return []
    keys = ("before", "after") if _is(occasion, "promoted") else ("before",)
    return [(float(occasion["week"]), errors[key]) for key in keys]


def _is(occasion: Document, outcome: str) -> bool:
    return bool(occasion["result"]) and occasion["result"]["outcome"] == outcome


def _changed(occasion: Document) -> bool:
    drift = occasion["result"] and occasion["result"]["drift"]
    return bool(drift and drift["changed"])


def _after(
    told: Document, weeks: Sequence[float], errors: FloatArray, promoted: Sequence[float]
) -> FloatArray:
    """(n,) mean errors after the promotion that followed the last change, as shares of before."""
    began = max(told["wear_weeks"], default=np.inf)
    last = next((week for week in promoted if weeks and week >= began and week > weeks[0]), None)
    if last is None:
        return np.full(errors.shape[1], np.nan)
    first = [i for i, week in enumerate(weeks) if week == last][-1]
    return np.asarray(np.mean(errors[first:] / errors[0], axis=0))


def _worn(told: Document) -> list[tuple[int, float]]:
    """Joints that are not as new in the end, and how much more friction they have."""
    factors = told["simulate"]["wear"][-1]["factors"] if told["wear_weeks"] else ()
    return [(j, float(factor)) for j, factor in enumerate(factors) if factor != 1]


def _back(told: Document, after: FloatArray) -> Iterator[Criterion]:
    """Whether the error is that of the first probe again, of all joints and of those that wore."""
    if not any(each["week"] >= weeks for weeks in told["wear_weeks"] for each in told["occasions"]):
        return
    mean = float(np.mean(after)) if len(after) else float("nan")
    yield Criterion(
        f"the error is back at that of the first probe, within {100 * (BACK - 1):.0f} %",
        mean <= BACK,
        f"{number(100 * mean)} % of it, mean over the joints and the probes since",
    )
    for j, factor in _worn(told):
        limit = BACK * max(factor, 1.0)
        share = float(after[j]) if len(after) else float("nan")
        yield Criterion(
            f"so is that of J{j + 1} by itself, within {100 * (BACK - 1):.0f} % beyond the wear: "
            f"at most {100 * limit:g} % of its own",
            share <= limit, f"{number(100 * share)} % of it, mean over the probes since",
        )  # fmt: skip


def _criteria(told: Document, occasions: Sequence[Document]) -> list[Criterion]:
    rows: list[Criterion] = []
    expected: list[float] = []
    for weeks in told["wear_weeks"]:
        probe = next((each for each in occasions if each["week"] >= weeks), None)
        if probe is None:
            continue
        week = float(probe["week"])
        expected.append(week)
        drift = probe["result"] and probe["result"]["drift"]
        rows.append(Criterion(
            f"the change after {7 * weeks:g} days is seen by the first probe after it",
            _changed(probe), f"week {week:g}: {drift['text'] if drift else probe['why']}",
        ))  # fmt: skip
        rows.append(Criterion(
            "the robot is identified again, and the challenger promoted",
            _is(probe, "promoted"), str((probe["result"] or {}).get("text", probe["why"])),
        ))  # fmt: skip
    needless = [
        float(each["week"])
        for each in occasions
        if _is(each, "promoted") and each["result"]["before"] and each["week"] not in expected
    ]
    rows.append(Criterion(
        "nothing is promoted without a change", not needless,
        listed([f"week {week:g}" for week in needless]) or "in no week",
    ))  # fmt: skip
    alarms = [each for each in occasions if _changed(each) and float(each["week"]) not in expected]
    probes = sum(bool(each["result"] and each["result"]["drift"]) for each in occasions)
    rows.append(Criterion(
        "no probe without a change calls the robot changed", not alarms,
        f"{len(alarms)} of {probes - len(expected)} do",
    ))  # fmt: skip
    return rows


def _sentences(told: Document, after: FloatArray) -> list[str]:
    occasions = told["occasions"]
    probes = sum(bool(each["result"] and each["result"]["drift"]) for each in occasions)
    changes = [
        f"after {7 * weeks:g} days friction is {worn(one['factors'])}"
        for weeks, one in zip(told["wear_weeks"], told["simulate"]["wear"], strict=True)
    ]
    said = [f"{probes} probes; {'; '.join(changes) or 'no wear'}."]
    for each in occasions:
        if _changed(each):
            result = each["result"]
            came = {"promoted": f"{result['champion']} is promoted", "kept": "the champion stays"}
            told_then = came.get(result["outcome"], "nothing is done")
            said.append(f"Week {each['week']:g}: {result['drift']['text']}; {told_then}.")
    if np.isfinite(after).any():
        each = [f"that of J{j + 1} {100 * after[j]:.0f} %" for j, _ in _worn(told)]
        mean = f"the mean error is {100 * float(np.mean(after)):.0f} % of the first probe's"
        said.append(f"Since then {listed([mean, *each])}.")
    return said


def worn(factors: Sequence[float], form: str = "{factor:g} times as much on {joint}") -> str:
    """Wear in words: `1.15 times as much on J2`; `as new` where there is none."""
    named = ((f"J{j + 1}", factor) for j, factor in enumerate(factors) if factor != 1)
    return ", ".join(form.format(joint=joint, factor=factor) for joint, factor in named) or "as new"
