"""Checkpoints of a network training: `checkpoint.json` with the progress, and a safetensors file.

The JSON document contains the name and the digest of the tensor file; each write replaces the
document atomically. A crash during a write therefore leaves either the previous or the new
checkpoint. A resumed training ends with the same bits as an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hil.core import CheckpointRefused, DataError, json_document, json_value, write_whole

FORMAT = 2
FILE = "checkpoint.json"

EVERY = 10.0
"""Minimum time [s] between two writes; an interrupt and the end of a training write in any case."""

SAME = 1e-3
"""Largest relative difference of an untrained network's error that rounding can explain."""

State = dict[str, torch.Tensor]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Complete state of a training after an epoch.

    Attributes:
        tensors: Groups of tensors by name: weights, best weights, Adam's moments, random states.
        facts: JSON values of the training state: stage, epoch and learning curves.
    """

    tensors: Mapping[str, State]
    facts: Mapping[str, Any]


_GARBLED = (
    OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError,
)  # fmt: skip
"""Exceptions that can occur when a damaged checkpoint document is read."""


class Checkpoints:
    """Checkpoints of one training in a folder.

    Args:
        folder: Folder of the checkpoints, which is created if it does not exist; the folder should
            contain no other files.
        training: Identity of the training: settings, stages and sizes.
        start: Errors of the untrained network, by name; a different value at resumption reveals
            that the data have changed.
    """

    def __init__(
        self, folder: Path, training: Mapping[str, Any], start: Mapping[str, float]
    ) -> None:
        self._folder = folder
        self._training = json_value(training)
        self._start = dict(start)
        self._last: Snapshot | None = None
        self._written = time.monotonic()

    def read(self) -> Snapshot | None:
        """Return the stored snapshot; None if the folder contains no checkpoint.

        Raises:
            CheckpointRefused: The checkpoint is damaged, or belongs to a different training or to a
                different version of hil.
        """
        from safetensors import SafetensorError

        path = self._folder / FILE
        if not path.exists():
            return None
        try:
            found = json.loads(path.read_bytes())
            self._require_format(found["hil_checkpoint"])
            self._require_same(found["training"], found["start"])
            if _digest(found["facts"]) != found["facts_sha256"]:
                raise ValueError("the stored state is damaged")
            return Snapshot(self._tensors(found), found["facts"])
        except (*_GARBLED, SafetensorError) as error:
            raise CheckpointRefused(
                f"{path} cannot be read: {error}",
                folder=self._folder,
                hint="delete the folder to restart the training",
            ) from error

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """Convert errors of the `with` block, which applies a snapshot, to `CheckpointRefused`.

        Raises:
            CheckpointRefused: The checkpoint is complete, but does not match the network.
        """
        try:
            yield
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise CheckpointRefused(
                f"the checkpoint in {self._folder} does not fit the network: {error!s:.300}",
                folder=self._folder,
                hint="delete the folder to restart the training",
            ) from error

    def keep(self, snapshot: Snapshot, *, now: bool = False) -> None:
        """Store an epoch in memory, and write it if `EVERY` seconds have passed or `now` is set."""
        self._last = snapshot
        if now or time.monotonic() - self._written >= EVERY:
            self.write()

    def write(self) -> None:
        """Write the epoch that was last passed to `keep`, if there is one.

        Raises:
            DataError: The folder cannot be written to.
        """
        if self._last is None:
            return
        try:
            self._write(self._last)
        except OSError as error:
            raise DataError(
                f"no checkpoint can be written in {self._folder}: {error.strerror}",
                hint="choose a different folder, or free disk space",
            ) from error
        self._last, self._written = None, time.monotonic()

    def _write(self, snapshot: Snapshot) -> None:
        from safetensors.torch import save

        content = save(
            {
                f"{group}/{name}": value.detach().cpu().clone().contiguous()
                for group, tensors in snapshot.tensors.items()
                for name, value in tensors.items()
            }
        )
        digest = hashlib.sha256(content).hexdigest()
        tensors = self._folder / f"state-{digest[:12]}.safetensors"
        document = {
            "hil_checkpoint": FORMAT,
            "training": self._training,
            "start": self._start,
            "facts": snapshot.facts,
            "facts_sha256": _digest(snapshot.facts),
            "tensors": tensors.name,
            "tensors_sha256": digest,
        }
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(tensors, content)
        write_whole(self._folder / FILE, json_document(document))
        for older in self._folder.glob("state-*.safetensors"):
            if older != tensors:
                older.unlink(missing_ok=True)

    def _tensors(self, found: Mapping[str, Any]) -> dict[str, State]:
        from safetensors.torch import load

        content = (self._folder / Path(found["tensors"]).name).read_bytes()
        if hashlib.sha256(content).hexdigest() != found["tensors_sha256"]:
            raise ValueError(f"{found['tensors']} is damaged")
        groups: dict[str, State] = {}
        for key, value in load(content).items():
            group, _, name = key.partition("/")
            groups.setdefault(group, {})[name] = value
        return groups

    def _require_format(self, version: object) -> None:
        if version != FORMAT:
            raise CheckpointRefused(
                f"{self._folder} contains a checkpoint of a different version of hil: format "
                f"{_short(version)}, supported: {FORMAT}",
                folder=self._folder,
                hint="delete the folder to restart the training, or use that version of hil",
            )

    def _require_same(self, training: Mapping[str, Any], start: Mapping[str, float]) -> None:
        differing = [
            f"{key} was {_short(training.get(key))}, now {_short(value)}"
            for key, value in self._training.items()
            if training.get(key) != value
        ] + [
            f"{name} before training was {start.get(name)}, now {value:.6g}"
            for name, value in self._start.items()
            if not _close(start.get(name), value)
        ]
        if differing:
            raise CheckpointRefused(
                f"{self._folder} contains the checkpoint of a different training: "
                f"{'; '.join(differing)}",
                folder=self._folder,
                hint="choose a different folder for this training, or use the data and settings "
                "of the stored one",
            )


def _digest(facts: Mapping[str, Any]) -> str:
    """Return the digest of the facts as JSON, which includes every digit of the learning curves.

    Learning curves decide when a training ends, so every digit of the learning curves matters.
    """
    return hashlib.sha256(json_document(facts)).hexdigest()


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _close(before: object, now: float) -> bool:
    return isinstance(before, float) and abs(before - now) <= SAME * abs(now)
