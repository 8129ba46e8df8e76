"""Pages of registered models: the list of model names, one name, and one version.

The page of a model name shows the history of champions, the drift of the robot according to its
probes, the versions, and the log. The pages of registered models cannot change the registry. The
pages show commands for a terminal, in which a promotion includes a comparison and a recorded
reason. A damaged version or log is listed as a problem; the rest of the page is shown.

The two charts (`timeline`, `control_chart`) are SVG. Coordinates are computed here, in a viewBox of
width `WIDTH`; templates draw the marks, and style sheets set the colours. All data of a chart are
also shown in a table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import FloatArray, HilError, RegistryError, quoted, shell_word
from hil.dashboard.rendering import page
from hil.dashboard.run_files import run_link
from hil.dashboard.settings import Settings, settings_of
from hil.estimators import MODEL_FILE
from hil.export import TARGETS
from hil.models import (
    CHAMPION_EVENTS,
    PROBES_FILE,
    UNITS,
    Aliases,
    ChartedProbe,
    Entry,
    ModelVersion,
    Probe,
    Registry,
    charted_probes,
    numbers_in,
    probes_of,
    read_log,
    read_version,
)
from hil.report import (
    UNKNOWN,
    Document,
    as_float,
    as_names,
    as_object,
    as_objects,
    count,
    in_words,
    joint_title,
    measure,
    number,
    when,
)


def models(request: Request) -> Response:
    """Show the list of all model names and their champions."""
    settings = settings_of(request)
    registry, problems = Registry(settings.registry), list[str]()
    rows = [_name_row(registry, name, problems) for name in registry.names()]
    return page(request, "models.html.j2", title="Models", models=rows, problems=problems)


def _name_row(registry: Registry, name: str, problems: list[str]) -> dict[str, Any]:
    versions = _versions_of(registry, name, problems)
    log, broken = _log_of(registry, name)
    if broken:
        problems.append(broken)
    aliases = Aliases.after(log)
    by_number = {one.number: one for one in versions}
    champion = by_number.get(aliases.champion)
    since = next((e.at for e in reversed(log) if e.event in CHAMPION_EVENTS), "")
    return {
        "name": name,
        "address": _address(name),
        "count": len(versions),
        "champion": aliases.champion,
        "challenger": aliases.challenger,
        "since": when(since),
        "estimator": str(champion.facts.get("estimator", "")) if champion else "",
        "serial": str(champion.facts.get("serial", "")) if champion else "",
        "error": _error_of(champion.facts) if champion else "",
        "newest": when(versions[-1].registered) if versions else "",
        "broken": bool(broken),
    }


def model(request: Request) -> Response:
    """Show the champions, the drift, the versions and the log of one model name."""
    settings, name = settings_of(request), request.path_params["name"]
    registry, problems = Registry(settings.registry), list[str]()
    versions = _require_versions(registry, name, problems)
    log, broken = _log_of(registry, name)
    aliases = Aliases.after(log)
    unit = _unit_of(versions[-1].facts) if versions else "A"
    return page(
        request, "model.html.j2", title=name, problems=problems, broken=broken,
        champion=aliases.champion, challenger=aliases.challenger, before=aliases.before,
        timeline=timeline(log) if log else None,
        log=[_log_row(name, entry) for entry in reversed(log)],
        versions=[_version_row(one, aliases, settings) for one in reversed(versions)],
        evidence=_newest_comparison(log),
        drift=_drift_of(name, request.query_params.get("feature", ""), unit, settings),
        commands=_model_commands(name, aliases, bool(broken), settings),
    )  # fmt: skip


def _version_row(one: ModelVersion, aliases: Aliases, settings: Settings) -> dict[str, Any]:
    return {
        "label": one.label,
        "address": _address(one.name, one.number),
        "role": _role_of(one.number, aliases),
        "estimator": str(one.facts.get("estimator", "")),
        "registered": when(one.registered),
        "by": one.by,
        "error": _error_of(one.facts),
        "run": _run_of(one, settings),
    }


def _model_commands(
    name: str, aliases: Aliases, broken: bool, settings: Settings
) -> list[tuple[str, str]]:
    """Return suitable terminal commands, as pairs of a description and a command."""
    where = f"--registry {shell_word(settings.registry)}"
    if broken:
        repair = f"hil models repair {name} {where}"
        return [("Rebuild the log from its intact lines and the version folders:", repair)]
    found = []
    if not aliases.champion:
        which = "challenger" if aliases.challenger else "v1"
        promote = f"hil models promote {name} {which} --reason TEXT {where}"
        found.append(("Make it the first champion, without a comparison:", promote))
    elif aliases.challenger:
        promote = f"hil models promote {name} challenger --on RUN --reason TEXT {where}"
        found.append(("Promote it if its error is smaller on a run unknown to both:", promote))
    if aliases.before:
        back = f"hil models rollback {name} --reason TEXT {where}"
        found.append((f"Roll back to v{aliases.before[-1]}, the previous champion:", back))
    found.append(("Evaluate a new probe of the robot:", f"hil drift {name} RUN {where}"))
    found.append(
        ("Check every file and the log against their digests:", f"hil models check {where}")
    )
    return found


def version(request: Request) -> Response:
    """Show all information about one model version."""
    settings, name = settings_of(request), request.path_params["name"]
    registry = Registry(settings.registry)
    _require_versions(registry, name, [])  # raises if the name does not exist
    found = read_version(registry.root / name, request.path_params["number"])
    log, broken = _log_of(registry, name)
    aliases = Aliases.after(log)
    return page(
        request, "version.html.j2", title=f"{name} {found.label}", name=name,
        address=_address(name), role=_role_of(found.number, aliases),
        intact=_intact(found), broken=broken,
        facts=[(label, text) for label, text in _version_facts(found) if text and text != UNKNOWN],
        run=_run_of(found, settings), evaluation=_evaluation(found.facts),
        files=sorted(found.files.items()),
        log=[_log_row(name, one) for one in reversed(log) if one.version == found.number],
        commands=_export_commands(found), evaluate=f"hil evaluate {shell_word(found.folder)} RUN",
    )  # fmt: skip


def _intact(one: ModelVersion) -> str:
    """Return the problem of the files of a version; empty if the files match their digests."""
    try:
        one.verify()
    except HilError as error:
        return " → ".join(filter(None, (error.message, error.hint)))
    return ""


def _version_facts(one: ModelVersion) -> list[tuple[str, str]]:
    facts, run = one.facts, as_object(one.facts.get("run"))
    git = as_object(facts.get("git"))
    changed = " with changes" if git.get("dirty") else ""
    keys = ("estimator", "protocol", "robot", "serial")
    return [
        *((key, str(facts.get(key) or "")) for key in keys),
        ("joints", in_words(facts.get("joint_names") or [])),
        ("effort", f"{facts.get('effort_kind', '')} [{_unit_of(facts)}]"),
        ("registered", f"{when(one.registered)} by {one.by}"),
        ("measured", when(run.get("started"))),
        ("operator", str(run.get("operator") or "")),
        ("fitted to", in_words(facts.get("trained_on") or [])),
        ("hil", str(as_object(facts.get("packages")).get("hil") or "")),
        ("source revision", f"{git['sha']}{changed}" if git.get("sha") else ""),
        ("digest", one.digest),
        ("folder", str(one.folder)),
    ]


def _evaluation(facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the prediction errors per joint on every data source of the evaluation."""
    names = as_names(facts.get("joint_names"))
    return [_source_errors(part, names) for part in as_objects(facts.get("evaluation"))]


def _source_errors(part: Document, names: Sequence[str]) -> dict[str, Any]:
    total = as_object(part.get("total"))
    columns = [total.get(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    known = [c if isinstance(c, list) and len(c) == len(names) else [None] * len(names)
             for c in columns]  # fmt: skip
    joints = [
        (joint_title(j, name), [number(as_float(column[j])) for column in known])
        for j, name in enumerate(names)
    ]
    means = [number(as_float(total.get(key))) for key in ("mean_raw", "mean_filtered")]
    what = str(part.get("source") or "")
    unit = str(part.get("unit") or "")
    return {"what": what, "unit": unit, "joints": [*joints, ("mean", [*means, UNKNOWN])]}


def _export_commands(one: ModelVersion) -> list[str]:
    folder = shell_word(one.folder)
    return [f"hil export {folder} --to {target} -o OUT" for target in TARGETS]


routes = [
    Route("/models", models),
    Route("/models/{name}", model),
    Route("/models/{name}/v{number:int}", version),
]


def registered_models(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Return the registered versions by the SHA-256 digest of the document of the model."""
    registry, found = Registry(settings.registry), dict[str, list[dict[str, Any]]]()
    for name in registry.names():
        for version in _versions_of(registry, name, []):
            digest = str(version.files.get(MODEL_FILE, ""))
            address = _address(name, version.number)
            link = {"text": f"{name} {version.label}", "address": address}
            found.setdefault(digest, []).append(link)
    return found


def _address(name: str, number: int = 0) -> str:
    """Return the path of the page of a model name, or of one of its versions."""
    return f"/models/{quoted(name)}" + (f"/v{number}" if number else "")


def _require_versions(registry: Registry, name: str, problems: list[str]) -> list[ModelVersion]:
    """Return the readable versions of a name; add the errors of other versions to `problems`.

    Raises:
        RegistryError: The model name does not exist.
    """
    if name not in registry.names():
        registry.versions(name)  # raises with similar names
        raise RegistryError(f"{registry.root} has no models of {name}", hint="see /models")
    return _versions_of(registry, name, problems)


def _versions_of(registry: Registry, name: str, problems: list[str]) -> list[ModelVersion]:
    """Return the readable versions of a name, oldest first, as in `_require_versions`."""
    home, found = registry.root / name, []
    for version_number in numbers_in(home):
        try:
            found.append(read_version(home, version_number))
        except HilError as error:
            problems.append(error.message)
    return found


def _log_of(registry: Registry, name: str) -> tuple[tuple[Entry, ...], str]:
    """Return the log and the problem of its chain of digests; a broken log is returned as empty."""
    try:
        return read_log(registry.root / name), ""
    except HilError as error:
        return (), " → ".join(filter(None, (error.message, error.hint)))


def _log_row(name: str, entry: Entry) -> dict[str, Any]:
    """Return the table row of a log entry."""
    glyph, words = GLYPHS[entry.event]
    return {
        "at": when(entry.at),
        "version": entry.label,
        "address": _address(name, entry.version),
        "glyph": glyph,
        "words": words,
        "reason": entry.reason,
        "by": entry.by,
    }


def _role_of(number_: int, aliases: Aliases) -> str:
    """Return the role of a version: `champion`, `challenger` or an empty text."""
    if number_ == aliases.champion:
        return "champion"
    return "challenger" if number_ == aliases.challenger else ""


def _run_of(one: ModelVersion, settings: Settings) -> dict[str, str]:
    """Return `text` and `address` of the run to which a version was fitted."""
    run = as_object(one.facts.get("run"))
    return run_link(str(run.get("folder") or ""), settings, str(run.get("uid") or ""))


def _error_of(facts: Mapping[str, Any]) -> str:
    """Return the mean raw RMSE on the first data source of the evaluation."""
    for part in as_objects(facts.get("evaluation")):
        error = as_float(as_object(part.get("total")).get("mean_raw"))
        if math.isfinite(error):
            return measure(error, part.get("unit"))
    return ""


def _unit_of(facts: Mapping[str, Any]) -> str:
    """Return the unit of effort of a model."""
    return "A" if facts.get("effort_kind") == "current" else "N·m"


def _newest_comparison(log: Sequence[Entry]) -> dict[str, Any] | None:
    """Return the newest comparison of two versions, per joint; None without a comparison."""
    for entry in reversed(log):
        comparison = as_object(entry.evidence.get("comparison"))
        names = as_names(comparison.get("joint_names"))
        errors = [comparison.get("champion_rmse"), comparison.get("challenger_rmse")]
        if not names or any(not isinstance(e, list) or len(e) != len(names) for e in errors):
            continue
        old, new = ([as_float(value) for value in error or ()] for error in errors)
        joints = [
            (joint_title(j, name), number(old[j]), number(new[j]), _times(old[j], new[j]))
            for j, name in enumerate(names)
        ]
        samples = comparison.get("samples")
        return {
            "version": f"v{entry.version}",
            "came": "promoted" if entry.event == "promoted" else "not promoted",
            "at": when(entry.at),
            "words": str(comparison.get("words") or ""),
            "unit": str(comparison.get("unit") or ""),
            "samples": count(samples) if isinstance(samples, int) else str(samples or ""),
            "blocks": comparison.get("blocks"),
            "days": str(as_object(entry.evidence.get("days")).get("words") or ""),
            "joints": joints,
        }
    return None


def _times(old: float, new: float) -> str:
    return number(new / old) if old > 0 else UNKNOWN


SHARES = ("friction", "gain")
"""Names of features that are shares and are shown in per cent."""


def _drift_of(name: str, feature: str, unit: str, settings: Settings) -> dict[str, Any]:
    """Return the keys `probes` (newest first), `features`, `feature`, `chart` and `problem`.

    Args:
        name: Name of the registered model.
        feature: Name of the feature to chart; any other text selects the feature with the latest
            change.
        unit: Unit of effort of the model.
        settings: Settings of the dashboard.
    """
    registry, problem = Registry(settings.registry), ""
    judged: Sequence[ChartedProbe] = ()
    probes: Sequence[Probe] = ()
    try:
        probes = probes_of(registry, name)
        judged = (
            _charted_probes(settings.registry, name, _stamp(settings.registry / name))
            if probes
            else ()
        )
    except HilError as error:
        problem = error.message
    except (OSError, ValueError) as error:  # a model file is invalid
        problem = f"the probes cannot be plotted: {error}"
    names = probes[-1].features.names if probes else ()
    chosen = feature if feature in names else _most_telling(probes)
    alike = [one for one in judged if one.probe.features.names == names]
    return {
        "problem": problem,
        "features": names,
        "feature": chosen,
        "unit": _feature_unit(chosen, unit),
        "chart": _drift_chart(alike, chosen) if alike else None,
        "probes": [_probe_row(probe, settings) for probe in reversed(probes)],
    }


@lru_cache(maxsize=32)
def _charted_probes(registry: Path, name: str, stamp: str) -> tuple[ChartedProbe, ...]:
    """Return the probes of the robot with their limits.

    The limits depend on the models, which are slow to load; the result is therefore cached per
    `stamp`.
    """
    return tuple(charted_probes(Registry(registry), name))


def _stamp(home: Path) -> str:
    """Return a text that changes after a new probe, and after a version was added or damaged."""
    found = [home / PROBES_FILE, *home.glob("v*/*")]
    return ";".join(f"{p.name}:{p.stat().st_mtime_ns}:{p.stat().st_size}" for p in sorted(found))


def _most_telling(probes: Sequence[Probe]) -> str:
    """Return the feature with the latest change; the first feature if none has changed."""
    for probe in reversed(probes):
        for cause in probe.causes:
            wanted = "load mass" if cause.name == "load" else cause.name
            if wanted in probe.features.names:
                return wanted
    return probes[-1].features.names[0] if probes else ""


def _drift_chart(judged: Sequence[ChartedProbe], feature: str) -> dict[str, Any]:
    # Without times, the coordinates of probes are their numbers.
    timed = all(np.isfinite(_seconds(one.probe.at)) for one in judged)
    if timed:
        judged = sorted(judged, key=lambda one: _seconds(one.probe.at))
    k = judged[0].probe.features.names.index(feature)
    scale = 100.0 if feature.rsplit(" ", 1)[1] in SHARES else 1.0
    rows = [(one.probe.features.values[k], one.expected[k], one.chart.limit[k]) for one in judged]
    values, expected, limit = scale * np.array(rows).T
    at = [_seconds(one.probe.at) if timed else float(i + 1) for i, one in enumerate(judged)]
    labels = [one.probe.at[:16] if timed else f"probe {i + 1}" for i, one in enumerate(judged)]
    changed = [bool(one.chart.alarm[k]) for one in judged]
    champions = [one.probe.champion for one in judged]
    return control_chart(values, expected, limit, at, changed, champions, labels)


def _seconds(at: str) -> float:
    try:
        moment = datetime.fromisoformat(at)
    except ValueError:
        return float("nan")
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _feature_unit(feature: str, effort: str) -> str:
    what = feature.rsplit(" ", 1)[-1]
    return "%" if what in SHARES else UNITS.get(what, effort)


def _probe_row(probe: Probe, settings: Settings) -> dict[str, Any]:
    chance = min(1.0, 2.0 * len(probe.features.names) * probe.p)
    return {
        "taken": when(probe.at) or "not known",
        "text": probe.text,
        "changed": probe.changed,
        "early": probe.reference < 2,
        "chance": "< 0.01 %" if chance < 1e-4 else f"{number(100 * chance, 2)} %",
        "champion": probe.champion,
        "source": run_link(probe.source, settings, probe.uid if probe.program else ""),
    }


WIDTH, LEFT, RIGHT = 720.0, 64.0, 16.0
ROW, TOP, BELOW = 30.0, 14.0, 44.0
HEIGHT = 240.0
MOST_EVENTS = 40
MOST_LABELS = 6
DATE = len("2026-11-22")

GLYPHS = {
    "registered": ("○", "registered"),
    "challenger": ("◇", "made challenger"),
    "promoted": ("▲", "promoted to champion"),
    "kept": ("✕", "compared and not promoted"),
    "rolled-back": ("◀", "champion again"),
    "head-adopted": ("·", "head of the log created"),
    "repaired": ("✚", "log repaired"),
}


def timeline(log: Sequence[Entry]) -> dict[str, Any]:
    """Return a chart of the champions with one row per version and one column per event.

    The chart shows only the newest `MOST_EVENTS` events.
    """
    log = [entry for entry in log if entry.version]  # events of the log itself have no version
    events = list(enumerate(log))[-MOST_EVENTS:]
    versions = sorted({entry.version for _, entry in events}, reverse=True)
    x = Scale(0, max(len(events) - 1, 1), LEFT + 14, WIDTH - RIGHT - 14)
    y = {version: TOP + ROW * (i + 0.5) for i, version in enumerate(versions)}
    bottom = TOP + ROW * len(versions)
    marks = [
        {"x": x(i), "y": y[entry.version], "glyph": GLYPHS[entry.event][0], "event": entry.event,
         "text": f"v{entry.version} {GLYPHS[entry.event][1]}, {entry.at[:16]} UTC"}
        for i, (_, entry) in enumerate(events)
    ]  # fmt: skip
    return {
        "width": WIDTH, "height": bottom + BELOW, "left": LEFT, "right": WIDTH - RIGHT,
        "bottom": bottom, "marks": marks, "spans": list(_reigns(events, x, y)),
        "rows": [{"y": y[version], "label": f"v{version}"} for version in versions],
        "ticks": _ticks([x(i) for i in range(len(events))], [entry.at for _, entry in events]),
        "glyphs": [glyph for event, glyph in GLYPHS.items() if any(e.event == event for e in log)],
        "left_out": len(log) - len(events),
    }  # fmt: skip


def _reigns(
    events: Sequence[tuple[int, Entry]], x: Scale, y: dict[int, float]
) -> Iterator[dict[str, float]]:
    """Yield the period of each champion: from a promotion or rollback to the next one."""
    crowned = [(i, e.version) for i, (_, e) in enumerate(events)
               if e.event in CHAMPION_EVENTS]  # fmt: skip
    ends = [*(i for i, _ in crowned), len(events)][1:]  # empty without a champion
    for (begin, version), end in zip(crowned, ends, strict=True):
        last = WIDTH - RIGHT if end == len(events) else x(end)
        yield {"x": x(begin), "y": y[version], "width": round(last - x(begin), 1)}


def control_chart(
    values: FloatArray,
    expected: FloatArray,
    limit: FloatArray,
    at: Sequence[float],
    changed: Sequence[bool],
    champions: Sequence[int],
    labels: Sequence[str],
) -> dict[str, Any]:
    """Return a chart of one feature in P probes, with the limits for an unchanged robot.

    Args:
        values: Measured values of the feature (P,).
        expected: Values that are expected for an unchanged robot (P,).
        limit: Minimum deviation from the expected value that counts as a change (P,).
        at: Unix times of the probes, or probe numbers (P,).
        changed: Flags of the probes in which a change was detected (P,).
        champions: Numbers of the versions with which the probes were compared (P,).
        labels: Texts below the marks of the probes (P,).
    """
    x = Scale(min(at), max(at) if max(at) > min(at) else min(at) + 1, LEFT + 12, WIDTH - RIGHT - 12)
    low, high = _range(values, expected, limit)
    y = Scale(low, high, HEIGHT, TOP)
    marks = [
        {"x": x(where), "y": y(value), "changed": bad, "top": y(middle + room),
         "height": round(max(y(middle - room) - y(middle + room), 1.0), 1),
         "text": f"{label}: {number(float(value))}, expected {number(float(middle))} "
                 f"± {number(float(room))}"}
        for where, value, middle, room, bad, label
        in zip(at, values, expected, limit, changed, labels, strict=True)
    ]  # fmt: skip
    other = [
        {"x": round((x(at[i]) + x(at[i - 1])) / 2, 1), "label": f"v{champions[i]}"}
        for i in range(1, len(at)) if champions[i] != champions[i - 1]
    ]  # fmt: skip
    return {
        "width": WIDTH, "height": HEIGHT + BELOW, "left": LEFT, "right": WIDTH - RIGHT,
        "top": TOP, "bottom": HEIGHT, "marks": marks, "champions": other,
        "levels": [{"y": y(level), "label": f"{level:.6g}"} for level in _levels(low, high)],
        "ticks": _ticks([mark["x"] for mark in marks], labels),
    }  # fmt: skip


def _range(values: FloatArray, expected: FloatArray, limit: FloatArray) -> tuple[float, float]:
    """Return the range of all values and limits, except the first limits, which are too wide."""
    known = limit <= 4.0 * float(np.median(limit))
    every = np.concatenate([values, (expected - limit)[known], (expected + limit)[known]])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    room = 0.08 * (high - low) or 1.0
    return low - room, high + room


def _levels(low: float, high: float) -> list[float]:
    """Return about four round values between `low` and `high`."""
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(one * power for one in (1, 2, 5, 10) if one * power >= rough)
    first = math.ceil(low / step)
    return [round(i * step, 12) for i in range(first, math.floor(high / step) + 1)]


@dataclass(frozen=True, slots=True)
class Scale:
    """Linear map from values to coordinates of a chart.

    Attributes:
        low, high: Smallest and largest value of the range.
        begin, end: Coordinates of `low` and `high`.
    """

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the coordinate of a value, clipped to the chart and rounded."""
        share = (value - self.low) / (self.high - self.low)
        return round(self.begin + min(max(share, -0.02), 1.02) * (self.end - self.begin), 1)


def _ticks(x: Sequence[float], labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return tick labels below the marks, without overlaps and without repeated texts.

    The tick labels are days, or times if all marks are on one day.
    """
    one_day = len({label[:10] for label in labels}) == 1 and len(labels[0]) > DATE
    room, found, used = (WIDTH - LEFT - RIGHT) / MOST_LABELS, list[dict[str, Any]](), set[str]()
    for where, label in zip(x, labels, strict=True):
        text = label[DATE + 1 : 16] if one_day else label[:DATE]
        wide = 2 if one_day and len(found) == 1 else 1  # the first has the day as well
        free = not found or where >= found[-1]["x"] + wide * room
        if free and text not in used:
            used.add(text)
            shown = text if found or not one_day else f"{label[:DATE]} {text}"
            found.append({"x": where, "label": shown})
    return found
