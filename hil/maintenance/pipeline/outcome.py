"""What came of an occasion: in a word, in a line, and in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hil.evaluation import evaluate, usable_part
from hil.importers import load_source
from hil.maintenance.pipeline.stages import Document
from hil.models import Registry

if TYPE_CHECKING:
    from hil.evaluation import Evaluation

Done = Mapping[str, Document]


def summary(name: str, done: Done, errors: Document | None) -> Document:
    """The document of `Work`, from those of the stages before.

    Args:
        name: In the registry.
        done: By stage.
        errors: From `errors_on`.
    """
    drift = done["drift"] if "changed" in done["drift"] else None
    decision = done["challenge"] if "promoted" in done["challenge"] else None
    before, challenger = done["begin"]["champion"], done["register"].get("version")
    champion = decision["champion"] if decision else before
    runs = {stage: done[stage].get("run") for stage in ("probe", "campaign", "check")}
    return {
        "outcome": _outcome(drift, decision),
        "text": _text(drift, decision, challenger),
        "name": name,
        "begun": done["begin"]["begun"],
        "before": _label(before),
        "champion": _label(champion),
        "challenger": _label(challenger),
        "drift": drift,
        "decision": decision,
        "held_out": done["fit"].get("held_out"),
        "errors": errors,
        "runs": {stage: run for stage, run in runs.items() if run},
    }


def errors_on(registry: Registry, name: str, done: Done) -> Document | None:
    """RMSE of the champion on probes, joint by joint: that of the beginning and that of the end.

    Returns:
        `unit`, `joint_names`, `before` (champion of the beginning on the first probe) and `after`
        (champion of the end on the last probe), (n,) each, against the filtered effort; None
        without a probe.

    Raises:
        DataError, RegistryError: A run or a version was removed or changed meanwhile.
    """
    first, last = done["probe"].get("run"), done["check"].get("run")
    if first is None:
        return None
    old = f"v{done['begin']['champion']}"
    new = f"v{done['challenge']['champion']}" if "champion" in done["challenge"] else old
    then = _on(registry, name, old, Path(first))
    now = then if last is None else _on(registry, name, new, Path(last))
    return {
        "unit": then.unit,
        "joint_names": list(then.joint_names),
        "before": then.total.rmse_filtered.tolist(),
        "after": now.total.rmse_filtered.tolist(),
    }


def _on(registry: Registry, name: str, label: str, run: Path) -> Evaluation:
    model = registry.load(name, label)
    return evaluate(model, usable_part(load_source(run), model))


def _outcome(drift: Document | None, decision: Document | None) -> str:
    if decision is not None:
        return "promoted" if decision["promoted"] else "kept"
    return "drift" if drift and drift["changed"] else "quiet"


def _text(drift: Document | None, decision: Document | None, challenger: int | None) -> str:
    if decision is None:
        return str(drift["text"]) if drift else "nothing was due"
    if decision["promoted"]:
        return f"{_label(challenger)} is champion: {decision['reason']}"
    champion = decision["champion"]
    stays = f"{_label(champion)} stays" if champion else "there is no champion yet"
    return f"{_label(challenger)} is not promoted, {stays}: {decision['reason']}"


def _label(number: int | None) -> str | None:
    return f"v{number}" if number else None
