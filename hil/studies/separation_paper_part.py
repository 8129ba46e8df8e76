"""The paper's protocol, shown: its tables, and in words what is wrong with them."""

from __future__ import annotations

import numpy as np

from hil.estimators import PAPER_PROTOCOL, Method
from hil.studies.result import Figure, Part
from hil.studies.separation_data import sample_noise
from hil.studies.separation_paper_run import PaperRun
from hil.studies.separation_paper_tables import paper_tables
from hil.studies.separation_printed import NETWORK_A, WORDS
from hil.studies.separation_text import layout_name, mean_of

PROTOCOL = f"{PAPER_PROTOCOL}, and samples of every pose are on both sides of the split"

SUMMARISED: tuple[Method, ...] = ("ls", "wls", "lasso", "elastic-net")


def paper_part(run: PaperRun, figures: tuple[Figure, ...], epochs: int) -> Part:
    """Everything found under the paper's protocol."""
    text = (_what(run, epochs), _target_inside(run), _leak(run), _noise(run), _choice(run))
    return Part("As in the paper", PROTOCOL, text, paper_tables(run, epochs), figures)


def paper_summary(run: PaperRun) -> list[str]:
    """What a reader should take away."""
    linear = ", ".join(
        f"{WORDS[method]} {mean_of(run.linear_rmse(method, run.partition.test)):.3f}"
        for method in SUMMARISED
    )
    return [
        f"Paper protocol (test RMSE in A, mean over the joints): {linear}; with networks "
        f"{mean_of(run.separated().test):.4f} per sample, {mean_of(run.beyond_noise()):.4f} with "
        f"the noise of single samples taken off.",
        f"The same networks give {mean_of(run.dealt[0].test):.4f} A when friction is dealt out "
        f"among the poses at random, and {mean_of(run.poses_held_out.test):.3f} A at poses that "
        "are really held out: the split by sample measures memory.",
    ]


def _what(run: PaperRun, epochs: int) -> str:
    return (
        f"What the paper does. Every pose is visited once (from which side is drawn): "
        f"{len(run.data.conditions)} poses, {len(run.data)} samples. The current i of a joint is "
        "regressed on gravity, i²·sign(i) and 1 (eq. 20); what that leaves, networks learn from "
        f"the angles of joints 2 to 5, one per joint, in up to {epochs} epochs. Of all samples "
        "75 % train, 20 % test, and 5 % are set aside. The samples of a dwell differ by noise of "
        "the encoders alone, so the networks see the mean angles of the dwell: its samples then "
        "are one row of more weight, which gives the same network in less time."
    )


def _target_inside(run: PaperRun) -> str:
    return (
        "What is wrong with it, first: the current is predicted from the current. i²·sign(i) is "
        "known only to who has measured i already. Joint 1 shows it: no gravity acts on it, its "
        f"current at rest is friction and nothing else, and yet {100 * run.explained(0):.0f} % of "
        "its variance are “explained”."
    )


def _leak(run: PaperRun) -> str:
    weights, poses = run.networks[run.layout].weights, len(run.data.conditions)
    sample, held_out = mean_of(run.separated().test), mean_of(run.poses_held_out.test)
    dealt = mean_of(run.dealt[0].test)
    return (
        "Second: the test is no test. Three quarters of the samples of each pose are trained on; "
        "the others ask for what has just been seen, and a network of "
        f"{weights} weights has {poses} numbers to remember. The table “What the split hides” "
        f"shows it twice. At poses that are really held out the error is {held_out:.3f} A instead "
        f"of {sample:.4f} A. And with friction dealt out among the poses at random, which nobody "
        f"can predict from the pose, the split by sample still gives {dealt:.4f} A."
    )


def _noise(run: PaperRun) -> str:
    of_current, left = mean_of(sample_noise(run.data)), mean_of(run.residual_noise())
    found = {
        "per test sample": run.separated().test,
        "per test sample with the noise taken off": run.beyond_noise(),
        "per dwell, all its samples averaged": run.means_rmse(),
    }
    told = "; ".join(
        f"{words} {mean_of(error):.4f} A ({int(np.sum(error <= NETWORK_A))} of {len(error)} "
        f"joints within {NETWORK_A} A)"
        for words, error in found.items()
    )
    return (
        f"What the numbers can be: one sample carries {of_current:.4f} A of noise (mean over the "
        "joints). The regressor takes up some of it, because it holds the same sample; "
        f"{left:.4f} A are left, and no model of the pose can be better than that per sample. "
        f"The paper's networks reach {NETWORK_A} A; these reach: {told}."
    )


def _choice(run: PaperRun) -> str:
    best = min(run.networks, key=lambda layout: mean_of(run.separated(layout).test))
    return f"By its test error, Table 3 chooses {layout_name(best)}."
