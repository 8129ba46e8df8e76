"""What is known of where a model came from, collected when it is registered."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hil.core import DataError, RegistryError, read_json, sha256_of
from hil.estimators import MODEL_FILE
from hil.evaluation import EVALUATION_FILE
from hil.recording import PARTIAL_SUFFIX, package_versions, source_revision

FIT_FOLDER = "fit"


def facts_of(model: Path, sources: Iterable[Path] = ()) -> dict[str, Any]:
    """Facts of a model folder.

    A model under `RUN/fit/`, or fitted to one run alone, is of that run, whose recordings' digests
    are in the run.

    Args:
        model: Its folder.
        sources: Recordings it was fitted to, where it is not of a run.

    Raises:
        DataError: The model's documents or the run's cannot be read.
        RegistryError: A source is not there.
    """
    document = read_json(model / MODEL_FILE)
    fitted, training = document.get("fitted", {}), document.get("training") or {}
    sources = list(sources)
    run = model.resolve().parent.parent if model.resolve().parent.name == FIT_FOLDER else None
    if run is None and len(sources) == 1 and (sources[0] / "start.json").is_file():
        run = sources[0].resolve()
    return {
        "estimator": document["estimator"],
        "protocol": fitted.get("protocol", ""),
        "robot": document["robot"].get("name", ""),
        "joint_names": fitted.get("joint_names", []),
        "effort_kind": fitted.get("effort_kind", ""),
        "serial": training.get("serial", ""),
        "trained_on": training.get("sources", []),
        "data": [str(source.resolve()) for source in sources],
        "data_sha256": _digests(run, sources),
        "run": _run(run),
        "evaluation": _evaluation(model),
        "packages": package_versions(),
        "git": source_revision(),
    }


def _digests(run: Path | None, sources: Iterable[Path]) -> dict[str, str]:
    """Path → SHA-256 of recordings: those a finished run has noted, and those named.

    Recordings of several runs have the same names: where another has it, the whole path is told.
    """
    found: dict[str, str] = {}
    for stop in sorted(run.glob("stop*.json")) if run is not None else ():  # one per attempt
        noted = read_json(stop).get("sha256", {})
        found |= {name: digest for name, digest in noted.items() if _is_recording(name)}
    for source in sources:
        if not source.exists():
            raise RegistryError(f"{source} is not there", hint="name the recordings as they are")
        whole = source.is_dir()
        noted = _digests(source, ()) if whole else {source.name: sha256_of(source)}
        for name, digest in noted.items():
            taken = found.get(name, digest) != digest
            found[str((source if whole else source.parent) / name) if taken else name] = digest
    return found


def _is_recording(name: str) -> bool:
    """Also one that a crash has cut off: what is whole in it is learned from."""
    return name.removesuffix(PARTIAL_SUFFIX).endswith(".mcap")


def _run(run: Path | None) -> dict[str, Any] | None:
    if run is None or not (run / "start.json").is_file():
        return None
    start = read_json(run / "start.json")
    keys = ("uid", "started", "operator", "host", "experiment", "robot_name", "seed")
    told = {key: start.get(key) for key in keys} | {"folder": str(run)}
    verdict = run / "verdict.json"
    return told | {"verdict": read_json(verdict) if verdict.is_file() else None}


def _evaluation(model: Path) -> Any:
    """The totals of `evaluation.json`; its tables stay in the file."""
    path = model / EVALUATION_FILE
    if not path.is_file():
        return None
    try:
        held = json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(f"{path} is no evaluation: {error}", hint="fit the model again") from error
    if not isinstance(held, dict):
        return None
    held_out = held.get("held_out") or {}
    parts = [
        {"source": held_out.get("what", ""), **held_out},
        *({"total": one, **one} for one in held.get("validation") or ()),
    ]
    keys = ("source", "unit", "total", "notes")
    return [{key: part[key] for key in keys if part.get(key)} for part in parts if "total" in part]
