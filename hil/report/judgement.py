"""The verdict in one word and one sentence, for page and terminal alike."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence

from hil.recording import RunDirectory
from hil.report.commissioning import next_commissioning
from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.facts import RunFacts
from hil.report.fit_facts import FitFacts
from hil.report.page import Badge, Mark
from hil.report.words import criterion_text, listed, number, quantity, with_unit

NO_SIGNAL = 0.9
"""NRMSE on the training data from which a joint counts as one without signal."""

ENDINGS: dict[str, tuple[str, Mark]] = {
    "interrupted": ("INTERRUPTED", "warn"),
    "running": ("RUNNING", ""),
    "stopped": ("STOPPED", "warn"),
    "tripped": ("TRIPPED", "fail"),
    "failed": ("FAILED", "fail"),
    "damaged": ("DAMAGED", "fail"),
}
RESUMABLE = ("interrupted", "stopped", "tripped", "failed")
VERDICTS: dict[bool | None, tuple[str, Mark]] = {
    True: ("PASSED", "pass"),
    False: ("REJECTED", "fail"),
    None: ("NOT JUDGED", ""),
}


def badge_of(facts: RunFacts) -> Badge:
    """How the run ended when it ended early, else the verdict on its models."""
    if facts.status in ENDINGS:
        return Badge(*ENDINGS[facts.status])
    return verdict_badge(facts.verdict.get("passed"))


def verdict_badge(passed: object) -> Badge:
    """The badge of a verdict; anything but true and false is not judged."""
    return Badge(*VERDICTS[passed if isinstance(passed, bool) else None])


def sentence_of(facts: RunFacts) -> str:
    """What came of the run, in words a lab person understands."""
    if facts.status in ENDINGS:
        return " ".join(filter(None, (_ending(facts), _progress(facts), _models(facts))))
    return _models(facts) or _without_model(facts)


def next_command(facts: RunFacts, run: str) -> str:
    """What to type next about the run at `run`; empty when nothing is left to do."""
    wanted = facts.estimators_wanted
    if facts.commissioning:
        return next_commissioning(facts)
    if facts.start.get("passive"):
        return "" if facts.fits else f"hil fit {run} --estimator {_fitting(facts)}"
    if _can_be_resumed(facts):
        return f"hil resume {run}"
    if facts.status == "completed" and wanted and not facts.fits:
        return f"hil fit {run} --estimator {wanted[0]}{_parameters_of_first(facts)}"
    if facts.status == "completed" and facts.studies_missing:
        return f"hil study {run}"
    if facts.status == "completed" and not (wanted or facts.fits or facts.spec.get("study")):
        weigh, fit = f"hil payload MODEL {run}", f"hil fit {run} --estimator rigid-wls"
        return weigh if _stands(facts) else fit
    return ""


def _can_be_resumed(facts: RunFacts) -> bool:
    """Return whether `hil resume` has something left to measure or to judge."""
    if not facts.whole or RunDirectory(facts.path).is_judged:
        return False
    unjudged = facts.status == "completed" and "replayed" not in facts.start
    return unjudged or facts.status in RESUMABLE


def _stands(facts: RunFacts) -> bool:
    """Whether the program is of poses, by its spec."""
    return as_object(facts.spec.get("excitation")).get("kind") == "dwell"


def _parameters_of_first(facts: RunFacts) -> str:
    """Those the spec gives its first fit, for a shell: `hil fit` reads no spec."""
    first = as_objects(facts.spec.get("fit"))[0]
    given = (f"{name}={json.dumps(value)}" for name, value in first.items() if name != "estimator")
    return "".join(f" --set {shlex.quote(text)}" for text in given)


def _fitting(facts: RunFacts) -> str:
    """The estimator for what was found in a recording without spec."""
    found = as_object(facts.recorded.get("complete"))
    standing = "dwell" in found and "trajectory" not in found
    return "static-wls" if standing else "rigid-wls"


def fit_sentence(fit: FitFacts) -> str:
    """How good one model is on what it has not seen."""
    what = fit.held_out.get("what")
    error, fast = fit.mean("rmse_raw"), fit.mean("noise_floor")
    text = (
        f"On held-out data{f' ({what})' if what else ''} the model {fit.name} predicts the "
        f"{quantity(fit.unit)} with an error of {number(error)} {fit.unit} "
        f"(RMSE, mean of {len(fit.joint_names)} joints)"
    )
    if math.isfinite(fast):
        text += f"; the measured signal's {fit.fast_part} is {number(fast)} {fit.unit} (RMS)"
    return text + "."


def verdict_words(facts: RunFacts) -> str:
    """`recording passed, model not judged`; empty when nothing has been judged yet."""
    if not facts.verdict:
        return ""
    said = [f"{part} {_word_of(facts.verdict, part)}" for part in ("recording", "model")]
    return ", ".join(said)


def failed_fits(facts: RunFacts) -> list[str]:
    """The models of the spec that are missing, why, and what to do."""
    return [
        f"{problem.get('estimator') or 'No model'} could not be fitted and judged: "
        + " → ".join(filter(None, (str(problem.get(key) or "") for key in ("error", "hint"))))
        for problem in as_objects(facts.verdict.get("problems"))
    ]


def nrmse_warning(fit: FitFacts) -> str:
    """That a limit on the mean NRMSE is about joints without signal too; empty if it is not.

    A joint counts as such when the model does no better than a constant even on the data it was
    fitted to: at rest, a joint whose axis is vertical carries no gravity at all.
    """
    limited = [r for r in fit.criteria if (r.get("metric"), r.get("per")) == ("nrmse", "mean")]
    trained = zip(fit.joint_names, fit.values("nrmse", "trained"), strict=True)
    silent = [name for name, value in trained if value >= NO_SIGNAL]
    if not (limited and silent):
        return ""
    return (
        f"{fit.label}: the limit on the mean NRMSE includes {listed(silent, 6)}, where a constant "
        "does as well even on the training data: there is no signal to explain, and NRMSE is 1 "
        "whatever the model is worth. Limit the RMSE instead (accept.rmse)."
    )


def criteria_sentence(rows: Sequence[Document]) -> str:
    """How many criteria are met, and which are not; empty without criteria."""
    missed = [row for row in rows if not row.get("passed")]
    if not rows:
        return ""
    if not missed:
        texts = list(dict.fromkeys(criterion_text(row) for row in rows))
        return (
            f"{'The criterion is' if len(rows) == 1 else 'All criteria are'} met: {listed(texts)}."
        )
    groups = dict.fromkeys(_group(row) for row in missed)
    words = [_missed([row for row in rows if _group(row) == group]) for group in groups]
    return f"Criteria are missed: {'; '.join(words)}."


def _group(row: Document) -> tuple[str, str]:
    return str(row.get("estimator") or ""), criterion_text(row)


def _missed(rows: Sequence[Document]) -> str:
    """`RMSE raw ≤ 0.02 A by 2 of 6 joints, worst elbow_joint with 0.034 A (static-wls)`."""
    missed = [row for row in rows if not row.get("passed")]
    worst = max(missed, key=lambda row: as_float(row.get("value")))
    model, criterion = _group(worst)
    found = with_unit(worst.get("value"), worst.get("unit"))
    several = f" by {len(missed)} of {len(rows)} joints, worst" if len(rows) > 1 else " by the"
    text = f"{criterion}{several} {worst.get('what')} with {found}"
    return f"{text} ({model})" if model else text


def _word_of(verdict: Document, part: str) -> str:
    """The word of one part; from the rows where the verdict is of an older hil."""
    told = as_object(verdict.get(part)).get("verdict")
    rows = [
        row
        for row in as_objects(verdict.get("rows"))
        if bool(row.get("estimator")) == (part == "model")
    ]
    found = all(row.get("passed") for row in rows) if rows else None
    return str(told or VERDICTS[found][0].lower())


def _models(facts: RunFacts) -> str:
    best = facts.judged_fits
    if not best:
        return ""
    rows = as_objects(facts.verdict.get("rows"))
    said = criteria_sentence(rows)
    if not best[0].is_honest:  # honest ones come first
        said = f"It is not judged: {best[0].protocol}. {said}".strip()
    elif rows and not any(row.get("estimator") for row in rows):
        said = f"It is not judged: the spec sets no criterion for models. {said}"
    return f"{fit_sentence(best[0])} {said or 'The spec sets no acceptance criteria.'}"


def _without_model(facts: RunFacts) -> str:
    done, wanted = "The recording is complete.", facts.estimators_wanted
    if facts.commissioning:
        return (
            f"{done} It is of a commissioning run, {facts.commissioning}: such runs are neither "
            "fitted nor judged."
        )
    if facts.fits:
        names = listed([fit.label for fit in facts.fits])
        return f"{done} {names} was fitted, but not judged on held-out data."
    if wanted:
        return (
            f"{done} The spec asks for {listed(wanted)}, but there is no fitted model in the run: "
            f"{'fitting failed' if failed_fits(facts) else 'fitting has not been done'}."
        )
    if facts.start.get("passive"):
        return f"{done} Somebody else drove the robot; nothing was fitted yet."
    said = criteria_sentence(as_objects(facts.verdict.get("rows")))
    text = f"{done} The spec asks for no model, so nothing was fitted."
    if _stands(facts):
        text += (
            " `hil payload` tells by a model of the bare arm what is mounted; `hil fit` makes one."
        )
    return f"{text} {said}".strip()


def _ending(facts: RunFacts) -> str:
    if facts.status == "interrupted":
        return (
            "The run ended without saying why: its process was killed, or the power failed. "
            "What had reached the disk by then is kept and shown here."
        )
    if facts.status == "running":
        return "The run is still going on; what had reached the disk by now is shown here."
    if facts.status == "damaged":
        return "The run directory is damaged; this page shows what can still be read."
    words = {
        "stopped": "The run was stopped early",
        "tripped": "An interlock stopped the robot",
        "failed": "The run failed",
    }
    reason = str(facts.stop.get("reason") or "no reason was recorded").strip()
    return f"{words[facts.status]}: {reason.rstrip('.')}."


def _progress(facts: RunFacts) -> str:
    """How far it came: by what was measured, or by the steps where nobody could count that."""
    if facts.measured:
        return f"Measured: {facts.measured}."
    if not facts.steps:
        return ""
    return f"{facts.steps_done} of {len(facts.steps)} steps were done."
