"""Tables 2, 3 and 4 of the static paper, and the one that shows what its split hides."""

from __future__ import annotations

import numpy as np

from hil.estimators import Method
from hil.studies.result import Table, Value
from hil.studies.separation_paper import METHODS
from hil.studies.separation_paper_run import Layout, PaperRun
from hil.studies.separation_printed import TABLE_2, TABLE_3, TABLE_4, TABLE_4_LAYOUT, WORDS
from hil.studies.separation_text import joint_titles, layout_name, mean_of, values, with_mean


def paper_tables(run: PaperRun, epochs: int) -> tuple[Table, ...]:
    """All of them."""
    return _table_2(run), _table_3(run, epochs), _table_4(run), _split(run)


def _table_2(run: PaperRun) -> Table:
    return Table(
        "table-2",
        "Table 2: five linear methods on eq. 20, RMSE of the test samples [A]",
        (
            "method",
            *joint_titles(run.data.n_joints),
            "mean",
            "mean, training samples",
            "in the paper",
            "fit [s]",
        ),
        tuple(_linear_row(run, method) for method in METHODS),
        "Fastest of three fits of all joints on one core, standard errors included where the "
        "method has them.",
    )


def _linear_row(run: PaperRun, method: Method) -> tuple[Value, ...]:
    test = run.linear_rmse(method, run.partition.test)
    train = mean_of(run.linear_rmse(method, run.partition.train))
    return WORDS[method], *with_mean(test), train, TABLE_2[method], run.linear[method].seconds


def _table_3(run: PaperRun, epochs: int) -> Table:
    return Table(
        "table-3",
        "Table 3: layouts of the networks, RMSE of gravity and friction [A], mean over the joints",
        (
            "layout",
            "hidden layers",
            "weights",
            "train",
            "test",
            "train in the paper",
            "test in the paper",
            "epochs",
            "training [s]",
        ),
        tuple(_layout_row(run, layout) for layout in run.networks),
        f"At most {epochs} epochs of Levenberg–Marquardt; a network is done when no step lowers "
        "its error any more. Epochs are means over the joints, seconds of one core for all of "
        "them. Errors are of single samples: what their noise alone costs is in Table 4.",
    )


def _layout_row(run: PaperRun, layout: Layout) -> tuple[Value, ...]:
    networks, found = run.networks[layout], run.separated(layout)
    printed: tuple[Value, ...] = TABLE_3.get(layout, (None, None))
    errors = mean_of(found.train), mean_of(found.test)
    training = round(float(networks.epochs.mean())), float(networks.seconds.sum())
    sizes = len(layout) - 2, networks.weights
    return layout_name(layout), *sizes, *errors, *printed, *training


def _table_4(run: PaperRun) -> Table:
    found = run.separated()
    columns = {
        "training samples": found.train,
        "test samples": found.test,
        "noise of a sample": run.residual_noise(),
        "test without noise": run.beyond_noise(),
        "test samples, averaged per dwell": run.means_rmse(run.partition.test),
        "all samples, averaged per dwell": run.means_rmse(),
    }
    n = run.data.n_joints
    printed = np.array(TABLE_4) if n == len(TABLE_4) else np.full((n, 2), np.nan)
    table = np.column_stack([*columns.values(), printed])
    body = [(name, *values(row)) for name, row in zip(joint_titles(n), table, strict=True)]
    body.append(("mean", *values(table.mean(axis=0))))
    return Table(
        "table-4",
        f"Table 4: gravity by WLS and friction by networks {layout_name(run.layout)}, RMSE [A]",
        ("joint", *columns, "train in the paper", "test in the paper"),
        tuple(body),
        "“noise of a sample” is the scatter of what WLS leaves about the mean of its dwell: no "
        "function of the pose gets below it. “test without noise” is √(test² − noise²), about the "
        "error against what the dwell's current is on average. “all samples” holds training "
        f"samples too. The paper's numbers are of networks {layout_name(TABLE_4_LAYOUT)}.",
    )


def _split(run: PaperRun) -> Table:
    rows = {
        "samples held out, as in the paper": run.separated(),
        "whole poses held out": run.poses_held_out,
        "friction dealt out among the poses, samples held out": run.dealt[0],
        "friction dealt out among the poses, whole poses held out": run.dealt[1],
    }
    return Table(
        "table-split",
        f"What the split hides: WLS and networks {layout_name(run.layout)}, test RMSE [A]",
        ("what is held out", *joint_titles(run.data.n_joints), "mean"),
        tuple((words, *with_mean(found.test)) for words, found in rows.items()),
        "Dealt out: what WLS leaves of each dwell is given to another dwell drawn at random, so "
        "that there is nothing about friction to be learned from the pose.",
    )
