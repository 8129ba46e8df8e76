"""The frozen sample, commands in it, and comparisons of what they make."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from hil.cli import main

HERE = Path(__file__).parent
SAMPLE = HERE / "sample.tar.xz"


def entered(unpacked: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the sample into a folder and make the copy the working directory."""
    lab = Path(shutil.copytree(unpacked, folder / "lab"))  # with its times: locks are old
    # The sample names its registry by the path that it had where it was made.
    (lab / "runs" / ".registries").write_text(json.dumps(str(lab / "registry")) + "\n", "utf-8")
    monkeypatch.chdir(lab)
    monkeypatch.setenv("HIL_LEASES", str(folder / "leases"))
    monkeypatch.delenv("HIL_STATION", raising=False)
    monkeypatch.delenv("HIL_REGISTRY", raising=False)
    return lab


def command(*words: object) -> tuple[int, str]:
    """Exit code and standard output of a command, in this process."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(sys, "argv", ["hil", *map(str, words)])
        try:
            main()
            code: Any = 0
        except SystemExit as ending:
            code = ending.code or 0
    return code, out.getvalue()


def told(*words: object) -> Any:
    """The document of a command that succeeds."""
    code, out = command(*words, "--json")
    assert code == 0, out
    return json.loads(out)


def run_of(lab: Path, name: str) -> Path:
    """The newest run of an experiment."""
    return max(lab.glob(f"runs/*/*/[0-9]*-{name}"), key=lambda run: run.name)


def layout(recording: Path) -> dict[str, Any]:
    """Everything about an MCAP file but what was measured."""
    from mcap.reader import make_reader

    with recording.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        topics = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            topics[channel.topic] = (
                channel.message_encoding, dict(channel.metadata).keys(),
                schema.name, schema.encoding, schema.data,
            )  # fmt: skip
        header = reader.get_header()
        metadata = {record.name: set(record.metadata) for record in reader.iter_metadata()}
        attached = sorted((a.name, a.media_type) for a in reader.iter_attachments())
    return {
        "profile": header.profile, "topics": topics, "metadata": metadata, "attached": attached,
    }  # fmt: skip


def parsed(text: str) -> Any:
    """Return a document, or a list of them where there is one a line."""
    try:
        return json.loads(text)
    except ValueError:
        return [json.loads(line) for line in text.splitlines()]


def missing(old: Any, new: Any, where: str = "$") -> list[str]:
    """Keys that are gone, and values that are of another kind; null may stand for anything."""
    if old is None or new is None:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        old = {key: value for key, value in old.items() if key != "packages"}  # of this computer
        gone = [f"{where}.{key} is gone" for key in old if key not in new]
        return gone + [
            line for key in old if key in new
            for line in missing(old[key], new[key], f"{where}.{key}")
        ]  # fmt: skip
    if isinstance(old, list) and isinstance(new, list):
        if old and not new:
            return [f"{where} is empty"]
        return missing(merged(old), merged(new), f"{where}[]")
    if kind_of(old) != kind_of(new):
        return [f"{where} is {kind_of(new)}, not {kind_of(old)}"]
    return []


def merged(items: list[Any]) -> Any:
    """One item with the keys of all."""
    known = [item for item in items if item is not None]
    if known and all(isinstance(item, dict) for item in known):
        keys = {key for item in known for key in item}
        return {key: merged([item.get(key) for item in known]) for key in keys}
    if known and all(isinstance(item, list) for item in known):
        return [one for item in known for one in item]
    return known[0] if known else None


def kind_of(value: Any) -> str:
    if isinstance(value, bool):
        return "true or false"
    return {dict: "a mapping", list: "a list", str: "text"}.get(type(value), "a number")


def differences(old: Any, new: Any, where: str = "") -> list[str]:
    """Where two documents differ by more than rounding."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(set(old) | set(new))
        return [line for k in keys for line in differences(old.get(k), new.get(k), f"{where}.{k}")]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return [line for i, pair in pairs for line in differences(*pair, f"{where}[{i}]")]
    if isinstance(old, float) and isinstance(new, float | int):
        return [] if new == pytest.approx(old, rel=1e-9, abs=1e-12) else [where]
    return [] if old == new else [where]


def compare(name: str, code: int, out: str, frozen: Path) -> None:
    """Hold a document against the frozen one: keys may have been added, none may be gone."""
    codes = json.loads((frozen / "json/exit-codes.json").read_text("utf-8"))
    assert code == codes[name] or (name, code) == ("doctor", 1), out  # of this computer
    old = (frozen / f"json/{name}.json").read_text("utf-8")
    assert missing(parsed(old), parsed(out)) == []
