"""What was checked, as a digest: what is started is that, or it is checked anew."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from hil.arms import arm_names
from hil.core import SpecError
from hil.planning import Experiment
from hil.spec import spec_hash


def digest_of(experiments: Iterable[Experiment], speed: str = "", first: str = "") -> str:
    """SHA-256 of everything that decides what the arm does, but for where it stands.

    Args:
        experiments: Each counts with its spec as resolved (a file of poses by its content), the
            station, and the description of an arm of one's own by its content.
        speed: Share of the speed, as typed.
        first: How much of the program, as typed.

    Raises:
        SpecError: A file that counts cannot be read.
    """
    told = [
        [spec_hash(one.spec), one.station.model_dump(mode="json"), _of_arm(one.robot.model)]
        for one in experiments
    ]
    text = json.dumps([told, speed, first], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _of_arm(model: str) -> str:
    """Of its file as it is now; `model_sha256` is about what this process read once."""
    if model in arm_names():
        return ""
    try:
        return hashlib.sha256(Path(model).read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None
