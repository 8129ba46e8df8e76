"""A training on disk: `checkpoint.json` says where it stands, a safetensors file the tensors.

The JSON names its tensors' file and the file's digest, and is replaced in one step, so a crash
leaves the checkpoint before or the one after. A training that is taken up again ends with the
same bits as one that was never interrupted.
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
"""Seconds between writes; an interrupt and the end of the training write as well."""

SAME = 1e-3
"""Relative difference up to which two machines' rounding explains an error before training."""

State = dict[str, torch.Tensor]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All of a training after an epoch.

    Attributes:
        tensors: Groups of tensors by name: weights, best, Adam's moments, random numbers.
        facts: Stage, epoch, curves.
    """

    tensors: Mapping[str, State]
    facts: Mapping[str, Any]


_GARBLED = (
    OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError,
)  # fmt: skip
"""What reading a damaged document may end with."""


class Checkpoints:
    """Checkpoints of one training in a folder.

    Args:
        folder: Made when there is none; nothing else should be in it.
        training: What makes this training another than others: settings, stages, sizes.
        start: Errors before the first step, by name: they tell other data from these.
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
        """What the folder holds; None when it is empty or not there.

        Raises:
            CheckpointRefused: It is of another training or version of hil, or damaged.
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
                raise ValueError("its facts are damaged")
            return Snapshot(self._tensors(found), found["facts"])
        except (*_GARBLED, SafetensorError) as error:
            raise CheckpointRefused(
                f"{path} cannot be read: {error}",
                folder=self._folder,
                hint="delete it to start this training anew",
            ) from error

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """While what was read is taken over.

        Raises:
            CheckpointRefused: It is whole, but not of this network.
        """
        try:
            yield
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise CheckpointRefused(
                f"the checkpoint in {self._folder} does not fit the network: {error!s:.300}",
                folder=self._folder,
                hint="delete it to start this training anew",
            ) from error

    def keep(self, snapshot: Snapshot, *, now: bool = False) -> None:
        """Remember an epoch, and write it when the last write is long enough ago."""
        self._last = snapshot
        if now or time.monotonic() - self._written >= EVERY:
            self.write()

    def write(self) -> None:
        """Write the epoch remembered last, if any.

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
                hint="name another folder, or make room",
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
                f"{self._folder} holds a checkpoint written by another version of hil: format "
                f"{_short(version)}, known here {FORMAT}",
                folder=self._folder,
                hint="delete it to start this training anew, or go on with that version of hil",
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
                f"{self._folder} holds the checkpoint of another training: {'; '.join(differing)}",
                folder=self._folder,
                hint="name another folder for this training, or go on with what the other had",
            )


def _digest(facts: Mapping[str, Any]) -> str:
    """Of the facts as JSON: one digit of a learning curve decides where a training ends."""
    return hashlib.sha256(json_document(facts)).hexdigest()


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _close(before: object, now: float) -> bool:
    return isinstance(before, float) and abs(before - now) <= SAME * abs(now)
