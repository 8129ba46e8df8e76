"""Rows of Table II of the PINN paper and of this project: estimator, parameters and inputs.

A row has its own model or corrects the model of another row (`families`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hil.core import plugins
from hil.data import FilterSettings
from hil.estimators import GROUP, RobotEstimator, estimator
from hil.networks import LAGRANGIAN_CHOICES, TRAINING, ResidualSettings
from hil.studies.dynamic_methods import METHODS as CLASSICAL

LATENCY_S = 0.02
"""Minimum age [s] of the measured torque that a model with torque history may use."""

PREVIOUS_S = 0.001
"""Minimum age [s] of the earlier torque in the reference error for a model that uses the current
torque.
"""

NETWORK, RESIDUAL, OURS = "lagrangian", "residual", "rigid-hysteresis"

USUAL_EPOCHS = {NETWORK: LAGRANGIAN_CHOICES["epochs"], RESIDUAL: TRAINING["epochs"]}
"""Default number of epochs by estimator, for estimators that train networks."""

LITERAL = "proposed-literal"
"""Table row with network, friction and training settings as printed in the paper.

The paper does not state the number of training epochs, so this row uses the same number as the
other rows.
"""


@dataclass(frozen=True, slots=True)
class Row:
    """Method for predicting joint torques, a row in the tables of the study.

    Attributes:
        key: Key of the row in the spec.
        words: Display name of the method; the tables of results use `words_at`.
        estimator: Name under which the estimator is registered.
        params: Parameters of the estimator in addition to the parameters that all rows share.
        on: Key of the row whose fitted model is corrected; empty if the row has its own model.
        sign: Whether the estimator uses the smoothed sign function, whose width is equal for all
            rows.
        torque: Whether the torque to be predicted is also an input: empty for no, `history` for
            earlier torques, `measured` for the measured torque.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    on: str = ""
    sign: bool = True
    torque: str = ""

    @property
    def learns(self) -> bool:
        """Whether the estimator is a network, which has a random seed and a number of epochs."""
        return self.estimator in USUAL_EPOCHS

    def words_at(self, rate_hz: float) -> str:
        """Return the display name of the row at a given sample rate [Hz].

        For a row with torque history, the name contains the latency: `latency_s` rounded up to a
        whole number of samples.
        """
        if self.torque != "history":
            return self.words
        lag = ResidualSettings(inputs="history", latency_s=self.params["latency_s"]).lag(rate_hz)
        return f"{self.words} at least {1e3 * lag / rate_hz:.3g} ms old"


def _classical_row(key: str) -> Row:
    known = CLASSICAL[key]
    return Row(key, known.words, known.estimator, known.params)


def _network_row(key: str, words: str, **params: Any) -> Row:
    return Row(key, words, NETWORK, params)


def _correction_row(key: str, words: str, **params: Any) -> Row:
    """Return a table row with a residual network that corrects the model of the row `proposed`.

    The residual network is kept for every joint whose error on the validation rows does not
    increase.
    """
    torque = params["inputs"] if params["inputs"] != "motion" else ""
    kept = {**params, "margin": 0.0}
    return Row(key, words, RESIDUAL, kept, "proposed", sign=False, torque=torque)


ROWS = {
    row.key: row
    for row in (
        *(_classical_row(key) for key in ("wls", "lmi", "irls")),
        _network_row("delan", "Method 4: DeLaN", friction="none", learning="joint"),
        _network_row(
            "delan-unconstrained", "Method 5: DeLaN, network of (q, qd) as published",
            friction="unconstrained", learning="joint",
        ),
        _network_row(
            "delan-dissipative", "Method 5: DeLaN, dissipative network",
            friction="dissipative", learning="joint",
        ),
        _network_row(
            "delan-coulomb", "Method 6: DeLaN, Coulomb and viscous friction",
            friction="coulomb", learning="joint",
        ),
        _network_row("proposed", "Proposed: DeLaN, Stribeck, hybrid", friction="stribeck"),
        _network_row(
            "proposed-joint", "Proposed, joint learning only",
            friction="stribeck", learning="joint",
        ),
        _network_row(
            LITERAL, "Proposed, settings as printed",
            friction="stribeck", protocol="paper", training={"epochs": USUAL_EPOCHS[NETWORK]},
        ),
        _network_row(
            "proposed-memory", "Proposed, friction with memory",
            friction="stribeck", direction="dahl",
        ),
        _correction_row(
            "rc-paper", "Proposed with RC, measured torque (as in the paper)",
            inputs="measured", layout="joint",
        ),
        _correction_row(
            "rc-history", "Proposed with RC, torque history",
            inputs="history", layout="joint", latency_s=LATENCY_S,
        ),
        _correction_row(
            "rc-motion", "Proposed with RC, no torque", inputs="motion", layout="joint"
        ),
        _correction_row(
            "rc-grouped", "Proposed with RC, no torque, joint by joint",
            inputs="motion", layout="grouped",
        ),
        Row("ours", "ours: friction with memory", OURS, sign=False),
        Row("ours-residual", "ours, with a residual network", RESIDUAL, on="ours", sign=False),
    )
}  # fmt: skip

ROW_KEYS = tuple(ROWS)

DEFAULT_KEYS = tuple(key for key in ROW_KEYS if key != LITERAL)
"""Keys of the table rows that are compared by default."""

ONE_TO_SIX = (
    "wls", "lmi", "irls", "delan", "delan-unconstrained", "delan-dissipative", "delan-coulomb",
)  # fmt: skip
"""Row keys of Methods 1 to 6."""


def families(chosen: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the keys of the selected rows, grouped by the key of the model that the rows use.

    Within a family of rows, the order of the selection is preserved.

    Args:
        chosen: Keys of the selected rows in `ROWS`.
    """
    found: dict[str, tuple[str, ...]] = {}
    for key in chosen:
        root = ROWS[key].on or key
        found[root] = (*found.get(root, ()), key)
    return found


def missing(row: Row) -> str:
    """Return the name of a required estimator that is not installed; empty if all are installed."""
    needed = [row.estimator, *([ROWS[row.on].estimator] if row.on else [])]
    known = plugins.names(GROUP)
    return next((name for name in needed if name not in known), "")


def extras_of(keys: Sequence[str]) -> dict[str, str]:
    """Return the optional dependencies (extras) of the rows, each with the reason why it is needed.

    The reason lists the rows that need the extra and the rows that do not need it (see
    `Study.extras`).
    """
    needing: dict[str, list[str]] = {}
    for key in (key for key in keys if not missing(ROWS[key])):
        rows = [ROWS[one] for one in (key, ROWS[key].on) if one]
        for extra in {e for row in rows for e in estimator(row.estimator, **row.params).extras()}:
            needing.setdefault(extra, []).append(key)
    return {extra: _for_rows(of, keys) for extra, of in needing.items()}


def _for_rows(needing: Sequence[str], keys: Sequence[str]) -> str:
    others = [key for key in keys if key not in needing]
    without = f"; methods: [{', '.join(others)}] do without" if others else ""
    return f"for its rows {', '.join(needing)}{without}"


def unfitted(
    row: Row, seed: int, sign_width: float, filters: FilterSettings, effort: float
) -> RobotEstimator:
    """Return an unfitted estimator for a row, with the parameters that all rows share.

    Args:
        row: Table row, an element of `ROWS`.
        seed: Random seed of the estimator, if it is a network.
        sign_width: Width of the smoothed sign function [rad/s], equal for every estimator that uses
            this function.
        filters: Filter settings, equal for all rows.
        effort: Factor by which the default number of epochs is multiplied.

    Raises:
        PluginError, SpecError: The estimator does not exist, or rejects one of its parameters.
    """
    shared: dict[str, Any] = {"filters": filters}
    if row.sign:
        shared["sign_width"] = sign_width
    if row.learns:
        shared["seed"] = seed
        if effort != 1.0:
            epochs = max(1, round(effort * USUAL_EPOCHS[row.estimator]))
            shared["training"] = {"epochs": epochs}
    return estimator(row.estimator, **{**row.params, **shared})
