"""Tables and sentences of a study of inverse dynamics: who is ahead, and where that is not known.

The tables are Table II of the PINN paper, its robot a ROKAE XB7S, and what it leaves out. The stray
0 behind the first digit of every printed figure is taken out, as in `hil.studies.dynamic_tables`:
with that, the mean of every row is the printed average.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import FloatArray
from hil.networks import LAGRANGIAN_CHOICES
from hil.studies.dynamic_tables import AVERAGES, TABLE_II
from hil.studies.inverse_cases import Held
from hil.studies.inverse_fits import FEWEST_SEEDS, Found, apart, beside, doubt
from hil.studies.inverse_methods import LATENCY_S, LITERAL, ONE_TO_SIX, PREVIOUS_S, ROWS
from hil.studies.result import Table, Value, joint_titles, listed, value, with_mean

ANOTHER = "as printed, another robot: "

MEASURES = {
    "filtered": "",
    "raw": "RMSE against the torque as measured",
    "moving": "RMSE in motion, |qd| > 0.05 rad/s",
    "within": "Measured torques in the 90 % band, 1.645 standard deviations to either side [%]",
}

PRINTED: dict[str, tuple[float, ...]] = {
    **TABLE_II,
    "delan": (86.61, 129.84, 73.14, 47.27, 15.76, 32.91),
    "delan-unconstrained": (45.77, 29.26, 19.58, 47.41, 9.52, 11.04),
    "delan-coulomb": (8.35, 11.72, 11.75, 8.48, 6.92, 4.10),
    "proposed": (6.29, 10.73, 4.11, 1.38, 0.65, 0.63),
    "rc-paper": (3.95, 5.80, 2.91, 0.72, 0.42, 0.40),
}
"""By key of `hil.studies.inverse_methods`."""

PRINTED_AVERAGES: dict[str, float] = {
    **AVERAGES,
    "delan": 64.25,
    "delan-unconstrained": 27.10,
    "delan-coulomb": 8.55,
    "proposed": 3.97,
    "rc-paper": 2.37,
}
"""As printed."""

_NOTE = (
    "Against the filtered torque; mean over the seeds, each of which draws the split and the "
    "networks anew; SD: of the mean over the joints. CPU s: the model that is corrected included. "
    "Repeated torque is no model: it is what torque history is worth by itself; a method that is "
    "given the torque of the very instant would have an error of 0 by repeating it. Noise: from "
    "what the filter takes out, which also holds signal above its cut-off. Rows of the paper are "
    "of a ROKAE XB7S, the stray 0 taken out of its figures."
)


def errors(found: Found, key: str, what: str) -> Table:
    """RMSE per joint with its spread; persistence beside rows that see torque; noise last."""
    rows: list[tuple[Value, ...]] = []
    for name in found.scores:
        seconds = float(np.mean([score.seconds for score in found.scores[name]]))
        rows.append(_row(found.words(name), found.mean(name, "filtered"),
                         found.spread(name, "filtered"), seconds))  # fmt: skip
        rows += _persistence(found, name)
    noise = _beside("noise that the filter leaves, if white", found.beside("noise"))
    rows.append((*noise, None))
    if found.n == len(PRINTED["wls"]):
        rows += [
            (ANOTHER + ROWS[name].words, *PRINTED[name], PRINTED_AVERAGES[name], None, None)
            for name in found.scores
            if name in PRINTED
        ]
    columns = ("method", *joint_titles(found.n), "mean", "SD over seeds", "CPU s")
    return Table(key, f"RMSE of joint torques, {what} [N·m]", columns, tuple(rows), _NOTE)


def _row(words: str, per_joint: FloatArray, *more: float) -> tuple[Value, ...]:
    return (words, *with_mean(per_joint), *(value(one) for one in more))


def _persistence(found: Found, name: str) -> list[tuple[Value, ...]]:
    if not ROWS[name].torque:
        return []
    held = repeated(found, name)
    words = f"the torque of {1e3 * held.age_s:.3g} ms ago, repeated"
    return [(words, *with_mean(held.error), None, None)]


def _beside(words: str, by_seed: FloatArray) -> tuple[Value, ...]:
    spread = np.std(by_seed.mean(axis=1), ddof=1) if len(by_seed) > 1 else np.nan
    return (words, *with_mean(by_seed.mean(axis=0)), value(float(spread)))


def largest(found: Found, key: str, what: str) -> Table:
    """MEP per joint."""
    rows = tuple(
        _row(found.words(name), found.mean(name, "percent"), found.spread(name, "percent"))
        for name in found.scores
    )
    columns = ("method", *joint_titles(found.n), "mean", "SD over seeds")
    note = (
        "100·max|e|/max|τ| over the judged samples: our reading of the paper's measure, which it "
        "names, [29], without a formula."
    )
    return Table(key, f"Largest errors (MEP), {what} [%]", columns, rows, note)


def decided(found: Found, key: str, rows: str) -> Table | None:
    """What residual networks decided about themselves, joint by joint and seed by seed.

    Args:
        found: What was judged.
        key: Of the table.
        rows: What the errors that decided are of.
    """
    told: list[tuple[Value, ...]] = [
        (found.words(name), i, *score.decided)
        for name, scores in found.scores.items()
        for i, score in enumerate(scores, start=1)
        if score.decided
    ]
    if not told:
        return None
    columns = ("method", "draw", *joint_titles(found.n))
    note = (
        f"Error without → with the network [N·m], {rows}. A network is dropped for a joint "
        "on which it does not help there: ours has to save 2 %, and evenly; the rows of the paper "
        "keep whatever helps at all."
    )
    return Table(key, "Residual networks: kept or dropped", columns, tuple(told), note)


def measured(found: Found, key: str, measure: str, note: str = "") -> Table:
    """Another measure per joint; rows for which nobody knows it are left out."""
    rows = [
        _row(found.words(name), found.mean(name, measure), found.spread(name, measure))
        for name in found.scores
        if np.any(np.isfinite(found.mean(name, measure)))
    ]
    if measure == "raw":
        rows.append(_beside("what the filter takes out", found.beside("removed")))
        note = "What the filter takes out is noise, and signal above its cut-off."
    unit = "" if measure == "within" else " [N·m]"
    columns = ("method", *joint_titles(found.n), "mean", "SD over seeds")
    return Table(key, MEASURES[measure] + unit, columns, tuple(rows), note)


def under_loads(found: Found) -> Table | None:
    """Errors on held-out motions with loads nobody trained on; None without any."""
    loads = carried(found)
    if not loads:
        return None
    rows: list[tuple[Value, ...]] = []
    for name in found.scores:
        cells: list[Value] = [value(found.average(name))]
        for load in loads:
            cells += [value(under(found, name, load, told)) for told in ("unaware", "aware")]
        rows.append((found.words(name), *cells))
    columns = ["method", "no other load"]
    for load in loads:
        columns += [f"{found.loads[load]} unaware", f"{found.loads[load]} aware"]
    note = (
        "Mean over joints and seeds, held-out motions, trained without these loads. Unaware: "
        "nobody says what is carried. Aware: mass, centre of mass and inertia are told."
    )
    title = "RMSE under loads that were not trained on [N·m]"
    return Table("table-loads", title, tuple(columns), tuple(rows), note)


def carried(found: Found) -> list[int]:
    """Numbers of the loads that any judged motion was recorded with."""
    scores = [score for scores in found.scores.values() for score in scores]
    return [load for load in found.loads if any(load in score.aware for score in scores)]


def under(found: Found, name: str, load: int, told: str) -> float:
    """Mean over joints and the seeds whose judged motions have the load; NaN without any."""
    by_seed = [getattr(score, told).get(load) for score in found.scores[name]]
    known = [float(np.mean(errors)) for errors in by_seed if errors is not None]
    return float(np.mean(known)) if known else float("nan")


def repeated(found: Found, name: str) -> Held:
    """What repeating torque is worth to a row that sees torque."""
    return found.persistence(PREVIOUS_S if ROWS[name].torque == "measured" else LATENCY_S)


def both(found: Sequence[Found]) -> Table:
    """Mean RMSE of every row under every protocol, with its spread."""
    names = [name for name in ROWS if any(name in one.scores for one in found)]
    rows: list[tuple[Value, ...]] = []
    for name in names:
        cells: list[Value] = []
        for one in found:
            known = name in one.scores
            cells += [value(one.average(name)) if known else None,
                      value(one.spread(name, "filtered")) if known else None]  # fmt: skip
        rows.append((found[0].words(name), *cells))
    columns = ["method"]
    for one in found:
        columns += [one.protocol, f"{one.protocol}: SD"]
    return Table("table-protocols", "Mean RMSE by protocol [N·m]", tuple(columns), tuple(rows))


TITLES = {"paper": "Samples split as in the paper", "honest": "Whole trajectories held out"}

LABELS = {
    "paper": "paper: samples split at random within trajectories",
    "honest": "honest",
}

TEXTS = {
    "paper": (
        "60/20/20 % of the recorded samples, drawn one by one along whole motions; models that "
        "thin the data learn from every so manyth sample of the same draw. A judged sample's "
        "neighbours, one sample away, were learned from: these errors say little about another "
        "motion.",
        "Only the split is the paper's: networks have the settings with which they converge "
        f"(softplus, loss: {LAGRANGIAN_CHOICES['loss']}, "
        f"at most {LAGRANGIAN_CHOICES['epochs']} epochs, "
        "and the dissipative network twice so many, at two rates), not the printed ones; "
        f" those are in the row “{ROWS[LITERAL].words}”, if it was asked for.",
    ),
    "honest": (
        "Nine of twelve trajectories are handed to every method, three are judged; networks hold "
        "out two of the nine by themselves to know when to stop.",
    ),
}

LEFT_OUT = {
    "paper": "on samples drawn from the motions learned from",
    "honest": "on trajectories it was not fitted to, none of them judged",
}
"""What residual networks are chosen by."""

OURS = ("ours-residual", "ours")

CHANGES = (
    ("proposed-joint", "proposed", "hybrid instead of joint learning", "joint learning"),
    ("proposed", "proposed-memory", "friction with memory in the Proposed network", "Proposed"),
    ("proposed", LITERAL, "the Proposed network with its settings as printed", "with ours"),
)
"""Rows that differ by one thing, that thing, and what it is set beside."""

ORDER = (
    ("delan", ("delan-unconstrained", "delan-dissipative")),
    ("delan-unconstrained", ("delan-coulomb", "proposed")),
    ("delan-dissipative", ("delan-coulomb", "proposed")),
)
"""Expected: each is worse than those behind it."""


def summary(found: Sequence[Found]) -> Iterator[str]:
    """What to take away, one sentence each."""
    for one in found:
        sentences = [
            *_ours(one), *_order(one), *_six_or_proposed(one), *_added(one), *_corrected(one),
            *_carried(one),
        ]  # fmt: skip
        yield from (f"{TITLES[one.protocol]}: {sentence}" for sentence in sentences)


def _ours(found: Found) -> Iterator[str]:
    known = [key for key in ONE_TO_SIX if _is_known(found, key)]
    ours = next((key for key in OURS if _is_known(found, key)), None)
    if {"ours", "ours-residual"} <= found.scores.keys() and np.array_equal(
        found.by_seed("ours"), found.by_seed("ours-residual")
    ):
        ours = "ours"  # the network was dropped throughout: what it stands on did it
    if not known:
        return
    best = min(known, key=found.average)
    least = found.average(best)
    if ours is None:
        yield f"the least error of Methods 1 to 6 is {least:.3g} N·m ({found.words(best)})."
        return
    error = found.average(ours)
    noise = float(np.mean(found.beside("noise")))
    name = f"the best of Methods 1 to 6, {found.words(best)}, {least:.3g} N·m"
    yield f"{found.words(ours)} leaves {error:.3g} N·m, {beside(found, ours, best, name)}."
    if least > noise and apart(found, ours, best):
        closed = 100 * (least - error) / (least - noise)
        gap = f"closes {closed:.0f} % of the gap to the noise, if that is white"
        yield f"{found.words(ours)} {gap}."


def _is_known(found: Found, key: str) -> bool:
    return key in found.scores and bool(np.isfinite(found.average(key)))


def _order(found: Found) -> Iterator[str]:
    pairs = [
        (worse, better)
        for worse, others in ORDER
        for better in others
        if worse in found.scores and better in found.scores
    ]
    if not pairs:
        return
    if len(found.seen) < FEWEST_SEEDS:
        yield f"nothing is put in order: {doubt(found)}."
        return
    sure = [pair for pair in pairs if apart(found, *pair)]
    wrong = [pair for pair in sure if found.average(pair[0]) < found.average(pair[1])]
    open_ = [pair for pair in pairs if pair not in sure]
    if not wrong and not open_:
        yield "the paper's order holds: Method 4 > Method 5 > Method 6 and Proposed."
    if wrong:
        yield f"the paper's order does not hold in {_pairs(wrong)}."
    if open_:
        told = f"the paper's order is not told apart from another in {_pairs(open_)}"
        yield f"{told}: {doubt(found)}."


def _pairs(pairs: Sequence[tuple[str, str]]) -> str:
    return listed([f"{_short(worse)} > {_short(better)}" for worse, better in pairs])


def _short(key: str) -> str:
    return ROWS[key].words.split(",")[0].split(":")[0] + (
        " (dissipative)" if key == "delan-dissipative" else ""
    )


def _six_or_proposed(found: Found) -> Iterator[str]:
    if not {"delan-coulomb", "proposed"} <= found.scores.keys():
        return
    six, proposed = found.average("delan-coulomb"), found.average("proposed")
    digits = 3 if f"{six:.3g}" != f"{proposed:.3g}" else 4
    told = [f"Method 6 ({six:.{digits}g} N·m)", f"Proposed ({proposed:.{digits}g} N·m)"]
    if not apart(found, "delan-coulomb", "proposed"):
        yield f"{told[0]} and {told[1]} are not told apart: {doubt(found)}."
        return
    if proposed < six:
        told.reverse()
    yield f"{told[0]} is ahead of {told[1]}."


def _added(found: Found) -> Iterator[str]:
    """What the loops of hybrid learning add, and what friction with memory does."""
    for before, after, words, name in CHANGES:
        if {before, after} <= found.scores.keys():
            told = beside(found, after, before, name)
            yield f"{words} leaves {found.average(after):.3g} N·m, {told}."


def _corrected(found: Found) -> Iterator[str]:
    for key in ("rc-motion", "rc-grouped"):
        if {key, "proposed"} <= found.scores.keys():
            told = beside(found, key, "proposed", "Proposed")
            yield f"{found.words(key)} leaves {found.average(key):.3g} N·m, {told}."
    for key in ("rc-paper", "rc-history"):
        if key in found.scores:
            error, held = found.average(key), repeated(found, key)
            yield (
                f"{found.words(key)} leaves {error:.3g} N·m; to repeat the torque of "
                f"{1e3 * held.age_s:.3g} ms ago leaves {float(np.mean(held.error)):.3g} N·m."
            )


def _carried(found: Found) -> Iterator[str]:
    loads = carried(found)
    if not loads:
        return
    load, name = loads[-1], found.loads[loads[-1]]
    keys = [key for key in found.scores if not ROWS[key].torque]
    told = [
        f"{words}, the least error is {least}"
        for how, words in (("unaware", "nobody told of it"), ("aware", "told of it"))
        if (least := _least(found, keys, load, how))
    ]
    if told:
        yield f"with {name}: {'; '.join(told)}."
    handed = _least(found, [key for key in found.scores if ROWS[key].torque], load, "unaware")
    if handed:
        yield (
            f"with {name} that nobody told of, {handed} is the least of the rows that see the "
            "measured torque, and so the load: they were handed the answer."
        )


def _least(found: Found, keys: Sequence[str], load: int, told: str) -> str:
    """Least error under a load, and whose; empty where nobody has one."""
    errors = {key: under(found, key, load, told) for key in keys}
    errors = {key: error for key, error in errors.items() if np.isfinite(error)}
    if not errors:
        return ""
    best = min(errors, key=lambda key: errors[key])
    return f"{errors[best]:.3g} N·m ({found.words(best)})"
