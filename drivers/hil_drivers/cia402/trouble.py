"""What is wrong with the arm, as the error that the next read raises."""

from __future__ import annotations

import time
from collections.abc import Sequence

from hil.core import RobotFault, RobotTimeout, StructArray
from hil.robot import Status
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.emergencies import error_text
from hil_drivers.cia402.judging import FAULTY
from hil_drivers.cia402.parting import stop_by_objects
from hil_drivers.cia402.samples import Samples
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.states import state_of, told_by

WORDS_S = 0.5
"""How long it may take until the core has heard all there is to say of a fault [s]."""

ASKED_S = 0.1
"""How long drives may take to say something of themselves, all together [s]."""

LOOK_S = 0.005
NEXT = (
    "see to the cause; faults that are for a person are reset by "
    "`python -m hil_drivers.cia402 reset STATION ROBOT`; then run or resume"
)
ALL_SILENT = (
    "all axes at once: see to the bus, its power, its adapter; on a simulated bus the computer is "
    "too busy: end other programs, or give the station `pace: free`"
)


class Trouble:
    """Knows whether the arm obeys; tells each fault once.

    Args:
        name: Of the robot.
        session: To the drives.
        samples: Of the same.

    Attributes:
        is_there: The arm does not obey any more.
    """

    def __init__(self, name: str, session: Session, samples: Samples) -> None:
        self._name, self._session, self._samples = name, session, samples
        self._said = ""
        self._untold = self.is_there = False

    def look(self, rows: StructArray) -> None:
        """Look at what was just read, and ask the core; new trouble stops all axes by SDO too."""
        known = self.is_there
        if said := self._session.core.take_problem():
            self._said, self._untold, self.is_there = said, True, True
        elif not self.is_there and (rows["status"] & int(Status.FAULT)).any():
            self._untold = self.is_there = True
        if self.is_there and not known:
            stop_by_objects(self._session.acyclic)

    @property
    def said(self) -> str:
        """What is wrong, as far as it was told by now."""
        return self._said or "a drive is in fault"

    def raise_it(self) -> None:
        """Raise what was found, once.

        Raises:
            RobotFault: With the axis, what it says, and what the others do.
        """
        if not self._untold:
            return
        self._untold = False
        self._await_words()
        all_silent = len(self._samples.silent) == len(self._session.options.nodes)
        hint = ALL_SILENT if all_silent else NEXT
        raise RobotFault(f"{self._name}: {self.said}{self._asked()}", hint=hint)

    def silence(self, within_s: float) -> RobotTimeout:
        """The error for no sample in that time, with who has kept it from being one."""
        names = [self._session.acyclic.name_of(axis) for axis in self._samples.silent]
        if names:
            return RobotTimeout(
                f"{self._name}: no answer from {', '.join(names)} within {within_s:g} s",
                hint="see to those drives and their line",
            )
        return RobotTimeout(
            f"{self._name}: no cycle was over within {within_s:g} s", hint="look for a busy machine"
        )

    def _await_words(self) -> None:
        until = time.monotonic() + WORDS_S
        while not self._said and time.monotonic() < until:
            self._said = self._session.core.take_problem()
            time.sleep(LOOK_S)

    def _asked(self) -> str:
        """What drives say of themselves by SDO: an EMCY may have been lost, or all process data."""
        acyclic, silent = self._session.acyclic, self._samples.silent
        codes = acyclic.at_once.read(od.ERROR_CODE, self._faulty(), ASKED_S)
        words = acyclic.at_once.read(od.STATUSWORD, silent, ASKED_S)
        told = {
            "603Fh": [f"{acyclic.name_of(a)} {error_text(code)}" for a, code in codes.items()],
            "6041h": [f"{acyclic.name_of(a)} {told_by(word)}" for a, word in words.items()],
        }
        return "".join(f" ({entry}: {'; '.join(said)})" for entry, said in told.items() if said)

    def _faulty(self) -> Sequence[int]:
        """Axes in fault, by the newest row; by what they say where it was an EMCY that told of one.

        A drive sends that before the process data that show the fault, and rows are read later.
        """
        if faulty := self._samples.faulty:
            return faulty
        silent = self._samples.silent
        others = [axis for axis in range(len(self._session.options.nodes)) if axis not in silent]
        words = self._session.acyclic.at_once.read(od.STATUSWORD, others, ASKED_S)
        return [axis for axis, word in words.items() if state_of(word) in FAULTY]
