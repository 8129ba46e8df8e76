"""The rows of the PINN paper's Table II, and ours: which estimator, on what, from which inputs.

A row either has a model of its own or corrects the model of another row (`families`).
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
"""How old the newest torque is at least that an observer with history may see."""

PREVIOUS_S = 0.001
"""How old torque has to be at least to be repeated beside an observer that sees that of now."""

NETWORK, RESIDUAL, OURS = "lagrangian", "residual", "rigid-hysteresis"

USUAL_EPOCHS = {NETWORK: LAGRANGIAN_CHOICES["epochs"], RESIDUAL: TRAINING["epochs"]}
"""Of the estimators that learn."""

LITERAL = "proposed-literal"
"""Network, friction and training as the paper prints them, but for the epochs: it prints no number
of them, so this row has as many as the others."""


@dataclass(frozen=True, slots=True)
class Row:
    """A way to predict joint torques.

    Attributes:
        key: In the spec.
        words: For people; tables of data have `words_at`.
        estimator: Name it is registered under.
        params: Of the estimator, beside those all share.
        on: Key of the row whose fitted model it corrects; empty for a model of its own.
        sign: Whether the estimator has a smooth sign, whose width all share.
        torque: What it sees of the torque it predicts: nothing, `history` or `measured`.
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
        """Whether it draws numbers: a network has a seed and can be trained longer."""
        return self.estimator in USUAL_EPOCHS

    def words_at(self, rate_hz: float) -> str:
        """Its words where samples come at this rate.

        A latency is a whole number of samples, so a history ends somewhat earlier than asked for.
        """
        if self.torque != "history":
            return self.words
        lag = ResidualSettings(inputs="history", latency_s=self.params["latency_s"]).lag(rate_hz)
        return f"{self.words} until {1e3 * lag / rate_hz:.3g} ms before"


def _classical_row(key: str) -> Row:
    known = CLASSICAL[key]
    return Row(key, known.words, known.estimator, known.params)


def _network_row(key: str, words: str, **params: Any) -> Row:
    return Row(key, words, NETWORK, params)


def _correction_row(key: str, words: str, **params: Any) -> Row:
    """A network on the Proposed one, kept wherever it does no harm to the rows it stops by."""
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
"""Compared unless others are asked for."""

ONE_TO_SIX = (
    "wls", "lmi", "irls", "delan", "delan-unconstrained", "delan-dissipative", "delan-coulomb",
)  # fmt: skip
"""Methods 1 to 6."""


def families(chosen: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """By key of a model of its own: the chosen rows that need it, it first if it is chosen.

    Args:
        chosen: Keys of `ROWS`.
    """
    found: dict[str, tuple[str, ...]] = {}
    for key in chosen:
        root = ROWS[key].on or key
        found[root] = (*found.get(root, ()), key)
    return found


def missing(row: Row) -> str:
    """Name of an estimator that the row needs and no distribution has here; empty if all are."""
    needed = [row.estimator, *([ROWS[row.on].estimator] if row.on else [])]
    known = plugins.names(GROUP)
    return next((name for name in needed if name not in known), "")


def extras_of(keys: Sequence[str]) -> dict[str, str]:
    """Extras that rows need, with these rows and those that do without (`Study.extras`)."""
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
    """The row's estimator with what all share.

    Args:
        row: One of `ROWS`.
        seed: Of a network.
        sign_width: Of the smooth sign, the same for every estimator that has one.
        filters: Preprocessing, the same for all.
        effort: Share of the usual epochs that networks are trained for.

    Raises:
        PluginError, SpecError: There is no such estimator, or it takes other parameters.
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
