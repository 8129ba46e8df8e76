"""What a study of dynamic identification says in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hil.studies.dynamic_methods import METHODS
from hil.studies.dynamic_protocols import Found

TITLES = {"paper": "As in the paper", "honest": "Whole trajectories held out"}

LABELS = {
    "paper": "paper: samples split at random within trajectories",
    "honest": "honest",
}

TEXTS = {
    "paper": (
        "60/20/20 % of the samples, drawn one by one. A test sample's neighbours in time were "
        "trained on, and at 100 Hz they are nearly the same sample: these errors say little about "
        "another motion.",
    ),
    "honest": (
        "7, 2 and 3 of twelve trajectories to fit on, to choose by and to judge on. Methods that "
        "choose nothing leave the two in the middle unused, so that all are fitted to the same.",
    ),
}

OURS = "hysteresis"
_CLASSICAL = ("ols", "wls", "lmi", "lmi-weighted", "irls", "ridge", "tls", "diffnea")


def summary(found: Sequence[Found]) -> Iterator[str]:
    """What to take away, one sentence each."""
    for one in found:
        known = [key for key in _CLASSICAL if key in one.scores]
        if known:
            best = min(known, key=lambda key: one.average(key, "filtered"))
            yield (
                f"{TITLES[one.protocol]}, the best memoryless method is {METHODS[best].words}: "
                f"{one.average(best, 'filtered'):.3g} N·m, mean over joints and splits."
            )
            if OURS in one.scores:
                ours = one.average(OURS, "filtered")
                yield (
                    f"Friction with memory leaves {ours:.3g} N·m, "
                    f"{100 * (1 - ours / one.average(best, 'filtered')):.0f} % less."
                )
