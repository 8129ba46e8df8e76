"""Tables and summary sentences of the inverse-dynamics study, including the ranking of methods.

The tables contain Table II of the PINN paper, whose robot is a ROKAE XB7S, and further measures.
The source text of the printed values has an extra 0 after the first digit of every number. The
extra 0 is removed as in `hil.studies.dynamic_tables`. The mean of every row then equals the average
printed in the paper.
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
    "raw": "RMSE relative to the unfiltered torque",
    "moving": "RMSE in motion, |qd| > 0.05 rad/s",
    "within": "Measured torques within the 90 % band of ± 1.645 standard deviations [%]",
}

PRINTED: dict[str, tuple[float, ...]] = {
    **TABLE_II,
    "delan": (86.61, 129.84, 73.14, 47.27, 15.76, 32.91),
    "delan-unconstrained": (45.77, 29.26, 19.58, 47.41, 9.52, 11.04),
    "delan-coulomb": (8.35, 11.72, 11.75, 8.48, 6.92, 4.10),
    "proposed": (6.29, 10.73, 4.11, 1.38, 0.65, 0.63),
    "rc-paper": (3.95, 5.80, 2.91, 0.72, 0.42, 0.40),
}
"""RMSE per joint [N·m] by row key of `inverse_methods`, as printed in the PINN paper."""

PRINTED_AVERAGES: dict[str, float] = {
    **AVERAGES,
    "delan": 64.25,
    "delan-unconstrained": 27.10,
    "delan-coulomb": 8.55,
    "proposed": 3.97,
    "rc-paper": 2.37,
}
"""Mean RMSE [N·m] by row key, as printed in the PINN paper."""

_NOTE = (
    "Errors relative to the filtered torque; mean over the seeds, each with a new random split and "
    "new networks. SD: standard deviation of the mean over the joints. CPU s: including the fit of "
    "the corrected model. Repeated torque is not a model: it is the error of repeating an earlier "
    "torque; a method that has the current torque among its inputs could reach an error of 0 by "
    "repeating it. Noise: estimated from the signal removed by the filter, which also contains "
    "signal above its cut-off frequency. The rows of the paper are for a different robot (ROKAE "
    "XB7S), with the misprinted 0 removed from its figures."
)


def errors(found: Found, key: str, what: str) -> Table:
    """Return the table of the RMSE per joint, with its spread over the seeds.

    The row of a model that uses measured torque is followed by a row with the error of repeating an
    earlier torque. The last computed row of the table contains the noise that the filter leaves in
    the torque.
    """
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
    """Return the table of the largest error over largest torque (MEP) per joint."""
    rows = tuple(
        _row(found.words(name), found.mean(name, "percent"), found.spread(name, "percent"))
        for name in found.scores
    )
    columns = ("method", *joint_titles(found.n), "mean", "SD over seeds")
    note = (
        "100·max|e|/max|τ| over the test samples: our interpretation of the measure, which the "
        "paper cites from [29] without a formula."
    )
    return Table(key, f"Largest errors (MEP), {what} [%]", columns, rows, note)


def decided(found: Found, key: str, rows: str) -> Table | None:
    """Return the table of residual networks, kept or dropped, per joint and seed.

    Args:
        found: Results of a protocol.
        key: Key of the table.
        rows: Description of the samples that decide whether a network is kept.
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
        f"Error without → with the network [N·m], {rows}. A network is dropped for a joint if it "
        "does not reduce the error on these samples: for our method, the reduction must be at "
        "least 2 % and evenly spread; for the methods of the paper, any reduction suffices."
    )
    return Table(key, "Residual networks: kept or dropped", columns, tuple(told), note)


def measured(found: Found, key: str, measure: str, note: str = "") -> Table:
    """Return the table of one measure per joint; rows without any value are omitted."""
    rows = [
        _row(found.words(name), found.mean(name, measure), found.spread(name, measure))
        for name in found.scores
        if np.any(np.isfinite(found.mean(name, measure)))
    ]
    if measure == "raw":
        rows.append(_beside("signal removed by the filter", found.beside("removed")))
        note = "The filter removes noise, and signal above its cut-off frequency."
    unit = "" if measure == "within" else " [N·m]"
    columns = ("method", *joint_titles(found.n), "mean", "SD over seeds")
    return Table(key, MEASURES[measure] + unit, columns, tuple(rows), note)


def under_loads(found: Found) -> Table | None:
    """Return the table of errors in held-out motions with payloads that were not used for training.

    None is returned if all payloads were used for training.
    """
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
        "Mean over joints and seeds on held-out motions; the models were trained without these "
        "loads. Unaware: the model has no information about the load. Aware: the model knows mass, "
        "centre of mass and inertia of the load."
    )
    title = "RMSE under loads that were not used for training [N·m]"
    return Table("table-loads", title, tuple(columns), tuple(rows), note)


def carried(found: Found) -> list[int]:
    """Return the payload numbers that occur in the test motions."""
    scores = [score for scores in found.scores.values() for score in scores]
    return [load for load in found.loads if any(load in score.aware for score in scores)]


def under(found: Found, name: str, load: int, told: str) -> float:
    """Return the mean error with a payload over the joints and seeds; NaN if no error is known."""
    by_seed = [getattr(score, told).get(load) for score in found.scores[name]]
    known = [float(np.mean(errors)) for errors in by_seed if errors is not None]
    return float(np.mean(known)) if known else float("nan")


def repeated(found: Found, name: str) -> Held:
    """Return the error of predicting each torque by an older torque, with the latency of a row."""
    return found.persistence(PREVIOUS_S if ROWS[name].torque == "measured" else LATENCY_S)


def both(found: Sequence[Found]) -> Table:
    """Return the table of the mean RMSE of every row under every protocol, with its spread."""
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
        "60/20/20 % of the recorded samples, drawn individually along whole motions; models that "
        "downsample the data learn from every n-th sample of the same draw. The neighbours of a "
        "test sample, one sample away, are training samples: these errors say little about other "
        "motions.",
        "Only the split follows the paper. The networks have settings with which they converge "
        f"(softplus, loss: {LAGRANGIAN_CHOICES['loss']}, "
        f"at most {LAGRANGIAN_CHOICES['epochs']} epochs; "
        "the dissipative network twice as many, at two learning rates). The settings as printed "
        f"are used in the row “{ROWS[LITERAL].words}”, if it was selected.",
    ),
    "honest": (
        "Every method learns from nine of twelve trajectories and is evaluated on three; networks "
        "use two of the nine as validation set for early stopping.",
    ),
}

LEFT_OUT = {
    "paper": "on samples drawn from the training motions",
    "honest": "on trajectories that are neither training nor test trajectories",
}
"""Names of the samples that decide whether a residual network is kept, by protocol."""

OURS = ("ours-residual", "ours")

CHANGES = (
    ("proposed-joint", "proposed", "hybrid instead of joint learning", "joint learning"),
    ("proposed", "proposed-memory", "friction with memory in the Proposed network", "Proposed"),
    ("proposed", LITERAL, "the Proposed network with its settings as printed", "with ours"),
)
"""Pairs of table rows that differ in one property of the method.

Each pair consists of the reference row, the changed row, the description of the change, and the
name of the reference.
"""

ORDER = (
    ("delan", ("delan-unconstrained", "delan-dissipative")),
    ("delan-unconstrained", ("delan-coulomb", "proposed")),
    ("delan-dissipative", ("delan-coulomb", "proposed")),
)
"""Expected ranking: each key is a row whose error is expected to be larger than the errors of the
rows in its tuple.
"""


def summary(found: Sequence[Found]) -> Iterator[str]:
    """Yield the main conclusions of the study, one sentence each."""
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
        ours = "ours"  # the network was dropped for all joints and seeds
    if not known:
        return
    best = min(known, key=found.average)
    least = found.average(best)
    if ours is None:
        yield f"the smallest error of Methods 1 to 6 is {least:.3g} N·m ({found.words(best)})."
        return
    error = found.average(ours)
    noise = float(np.mean(found.beside("noise")))
    name = f"the best of Methods 1 to 6, {found.words(best)}, {least:.3g} N·m"
    less = beside(found, ours, best, name)
    yield f"{found.words(ours)} yields an error of {error:.3g} N·m, {less}."
    if least > noise and apart(found, ours, best):
        closed = 100 * (least - error) / (least - noise)
        gap = f"closes {closed:.0f} % of the gap to the noise, if the noise is white"
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
        yield f"the methods are not ranked: {doubt(found)}."
        return
    sure = [pair for pair in pairs if apart(found, *pair)]
    wrong = [pair for pair in sure if found.average(pair[0]) < found.average(pair[1])]
    open_ = [pair for pair in pairs if pair not in sure]
    if not wrong and not open_:
        yield "the ranking of the paper holds: Method 4 > Method 5 > Method 6 and Proposed."
    if wrong:
        yield f"the ranking of the paper does not hold for {_pairs(wrong)}."
    if open_:
        told = f"the ranking of the paper is not significant for {_pairs(open_)}"
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
        yield f"{told[0]} and {told[1]} do not differ significantly: {doubt(found)}."
        return
    if proposed < six:
        told.reverse()
    yield f"{told[0]} has a smaller error than {told[1]}."


def _added(found: Found) -> Iterator[str]:
    """Yield sentences about the effect of hybrid learning and of friction with memory."""
    for before, after, words, name in CHANGES:
        if {before, after} <= found.scores.keys():
            told = beside(found, after, before, name)
            yield f"{words} yields an error of {found.average(after):.3g} N·m, {told}."


def _corrected(found: Found) -> Iterator[str]:
    for key in ("rc-motion", "rc-grouped"):
        if {key, "proposed"} <= found.scores.keys():
            told = beside(found, key, "proposed", "Proposed")
            yield f"{found.words(key)} yields an error of {found.average(key):.3g} N·m, {told}."
    for key in ("rc-paper", "rc-history"):
        if key in found.scores:
            error, held = found.average(key), repeated(found, key)
            yield (
                f"{found.words(key)} yields an error of {error:.3g} N·m; repeating the torque of "
                f"{1e3 * held.age_s:.3g} ms ago yields {float(np.mean(held.error)):.3g} N·m."
            )


def _carried(found: Found) -> Iterator[str]:
    loads = carried(found)
    if not loads:
        return
    load, name = loads[-1], found.loads[loads[-1]]
    keys = [key for key in found.scores if not ROWS[key].torque]
    told = [
        f"{words}, the smallest error is {least}"
        for how, words in (
            ("unaware", "without information about it"),
            ("aware", "with this information"),
        )
        if (least := _least(found, keys, load, how))
    ]
    if told:
        yield f"with {name}: {'; '.join(told)}."
    handed = _least(found, [key for key in found.scores if ROWS[key].torque], load, "unaware")
    if handed:
        yield (
            f"with {name} and without information about it, {handed} is the smallest error of the "
            "rows that use the measured torque, which contains the effect of the load."
        )


def _least(found: Found, keys: Sequence[str], load: int, told: str) -> str:
    """Return the smallest error with a payload and its row; empty if no row has a value."""
    errors = {key: under(found, key, load, told) for key in keys}
    errors = {key: error for key, error in errors.items() if np.isfinite(error)}
    if not errors:
        return ""
    best = min(errors, key=lambda key: errors[key])
    return f"{errors[best]:.3g} N·m ({found.words(best)})"
