"""What a study of inverse dynamics says in words: who is ahead, and where nobody can tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.networks import LAGRANGIAN_CHOICES
from hil.studies.inverse_found import Found
from hil.studies.inverse_methods import LITERAL, ONE_TO_SIX, ROWS
from hil.studies.inverse_ranks import FEWEST_SEEDS, apart, beside, doubt
from hil.studies.inverse_tables import carried, repeated, under
from hil.studies.separation_text import listed

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


def _is_known(found: Found, key: str) -> bool:
    return key in found.scores and bool(np.isfinite(found.average(key)))


def _pairs(pairs: Sequence[tuple[str, str]]) -> str:
    return listed([f"{_short(worse)} > {_short(better)}" for worse, better in pairs])


def _short(key: str) -> str:
    return ROWS[key].words.split(",")[0].split(":")[0] + (
        " (dissipative)" if key == "delan-dissipative" else ""
    )
