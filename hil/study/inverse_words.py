"""What a study of inverse dynamics says in words: who is ahead, and where nobody can tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.study.inverse_found import Found
from hil.study.inverse_methods import ONE_TO_SIX, ROWS
from hil.study.inverse_tables import carried, repeated, under
from hil.study.separation_text import listed

TITLES = {"paper": "As in the paper", "honest": "Whole trajectories held out"}

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
    ),
    "honest": (
        "Nine of twelve trajectories are handed to every method, three are judged; networks hold "
        "out two of the nine by themselves to know when to stop.",
    ),
}

APART = 2.0
"""Standard deviations over the seeds by which paired errors must differ for a ranking."""

OURS = ("ours-residual", "ours")
CHANGES = (
    ("proposed-joint", "proposed", "hybrid instead of joint learning"),
    ("proposed", "proposed-memory", "friction with memory in the Proposed network"),
)
"""Rows that differ by one thing, and that thing."""

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


def apart(found: Found, a: str, b: str) -> bool:
    """Whether a and b differ by more than two seed-σ of their paired differences."""
    difference = found.by_seed(a) - found.by_seed(b)
    if len(difference) < 2:
        return False
    return abs(float(np.mean(difference))) > APART * float(np.std(difference, ddof=1))


def _ours(found: Found) -> Iterator[str]:
    known = [key for key in ONE_TO_SIX if key in found.scores]
    ours = next((key for key in OURS if key in found.scores), None)
    if not known:
        return
    best = min(known, key=found.average)
    least = found.average(best)
    if ours is None:
        yield f"the best of Methods 1 to 6 is {ROWS[best].words}: {least:.3g} N·m."
        return
    error = found.average(ours)
    noise = float(np.mean(found.beside("noise")))
    closed = 100 * (least - error) / (least - noise) if least > noise else float("nan")
    yield (
        f"{ROWS[ours].words} leaves {error:.3g} N·m, {_less(error, least)} than the best of "
        f"Methods 1 to 6 ({ROWS[best].words}, {least:.3g} N·m); it closes {closed:.0f} % of the "
        "gap to the noise."
    )


def _order(found: Found) -> Iterator[str]:
    pairs = [
        (worse, better)
        for worse, others in ORDER
        for better in others
        if worse in found.scores and better in found.scores
    ]
    if not pairs:
        return
    wrong = [pair for pair in pairs if found.average(pair[0]) <= found.average(pair[1])]
    open_ = [pair for pair in pairs if pair not in wrong and not apart(found, *pair)]
    if not wrong and not open_:
        yield "the paper's order holds: Method 4 > Method 5 > Method 6 and Proposed."
    for told, verb in ((wrong, "does not hold"), (open_, f"holds, but by {_doubt(found)},")):
        if told:
            shown = listed([f"{_short(a)} > {_short(b)}" for a, b in told])
            yield f"the paper's order {verb} in {shown}."


def _six_or_proposed(found: Found) -> Iterator[str]:
    if not {"delan-coulomb", "proposed"} <= found.scores.keys():
        return
    six, proposed = found.average("delan-coulomb"), found.average("proposed")
    if not apart(found, "delan-coulomb", "proposed"):
        yield (
            f"Method 6 ({six:.3g} N·m) and Proposed ({proposed:.3g} N·m) are not ranked: their "
            f"errors differ by {_doubt(found)}."
        )
    elif proposed < six:
        yield f"Proposed ({proposed:.3g} N·m) is ahead of Method 6 ({six:.3g} N·m)."
    else:
        yield f"Method 6 ({six:.3g} N·m) is ahead of Proposed ({proposed:.3g} N·m)."


def _added(found: Found) -> Iterator[str]:
    """What the loops of hybrid learning add, and what friction with memory does."""
    for before, after, words in CHANGES:
        if {before, after} <= found.scores.keys():
            reference, error = found.average(before), found.average(after)
            told = "" if apart(found, before, after) else f", by {_doubt(found)}"
            yield f"{words} leaves {error:.3g} N·m, {_less(error, reference)}{told}."


def _carried(found: Found) -> Iterator[str]:
    loads = carried(found)
    if not loads:
        return
    errors = {
        told: {key: under(found, key, loads[-1], told) for key in found.scores}
        for told in ("unaware", "aware")
    }
    shown = {told: min(of, key=lambda key: of[key]) for told, of in errors.items()}
    yield (
        f"with {found.loads[loads[-1]]} that nobody told of, the least error is "
        f"{errors['unaware'][shown['unaware']]:.3g} N·m ({ROWS[shown['unaware']].words}); told of "
        f"it, {errors['aware'][shown['aware']]:.3g} N·m ({ROWS[shown['aware']].words})."
    )


def _corrected(found: Found) -> Iterator[str]:
    for key in ("rc-motion", "rc-grouped"):
        if {key, "proposed"} <= found.scores.keys():
            base, error = found.average("proposed"), found.average(key)
            yield f"{ROWS[key].words} leaves {error:.3g} N·m, {_less(error, base)} than Proposed."
    for key in ("rc-paper", "rc-history"):
        if key in found.scores:
            error, held = found.average(key), repeated(found, key)
            yield (
                f"{ROWS[key].words} leaves {error:.3g} N·m; to repeat the torque of "
                f"{1e3 * held.age_s:.3g} ms ago leaves {float(np.mean(held.error)):.3g} N·m."
            )


def _doubt(found: Found) -> str:
    return (
        "less than two seed-σ" if len(found.seen) > 1 else "what one seed cannot tell from chance"
    )


def _less(error: float, reference: float) -> str:
    percent = 100 * (1 - error / reference)
    return f"{percent:.0f} % less" if percent >= 0 else f"{-percent:.0f} % more"


def _short(key: str) -> str:
    return ROWS[key].words.split(",")[0].split(":")[0] + (
        " (dissipative)" if key == "delan-dissipative" else ""
    )
