"""What the cycles leave behind, taken from the thread that owns the bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hil.core import StructArray
from hil.robot import Topic
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.mapping import INCOMPLETE
from hil_drivers.cia402.rows import TOPIC, StateRows, raw_rows
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.states import State, state_of


class Samples:
    """State rows for who reads, raw rows for who records.

    Args:
        session: To the drives.
        topic: Of the raw rows.
    """

    def __init__(self, session: Session, topic: Topic) -> None:
        options = session.options
        self._core: Core = session.core
        self._mapping, self._topic, self._period_s = session.mapping, topic, options.period_s
        self._rows = StateRows(
            session.mapping, session.drives.scaling, options.period_s, options.effort
        )
        self._raw: list[StructArray] = []
        self._newest: StructArray | None = None

    def take(self, timeout_s: float) -> StructArray:
        """State rows of all cycles since the last call; none when axes have not answered.

        Raises:
            RobotTimeout: There was no cycle.
            RobotConnectionError: The bus is gone.
        """
        cycles = self._core.take(timeout_s)
        self._raw.append(raw_rows(cycles, self._mapping, self._topic, self._period_s))
        self._newest = self._raw[-1][-1:]
        return self._rows.rows(cycles)

    def forget(self) -> None:
        """What was so far is nobody's business: the axes were being enabled."""
        self.take(1.0)
        self._raw = []

    def drain(self) -> Mapping[str, StructArray]:
        """Raw rows since the last call."""
        raw, self._raw = self._raw, []
        return {TOPIC: np.concatenate(raw)} if raw else {}

    @property
    def silent(self) -> Sequence[int]:
        """Axes that have not answered in the newest cycle."""
        flags = 0 if self._newest is None else int(self._newest[0]["flags"]) & INCOMPLETE
        return [axis for axis in range(flags.bit_length()) if flags >> axis & 1]

    @property
    def faulty(self) -> Sequence[int]:
        """Axes that were in fault in the newest cycle, and have answered in it."""
        if self._newest is None:
            return ()
        row = self._newest[0]
        silent = int(row["flags"]) & INCOMPLETE
        return [
            axis
            for axis, word in enumerate(row["statusword"].tolist())
            if state_of(word) in (State.FAULT, State.FAULT_REACTION) and not silent >> axis & 1
        ]
