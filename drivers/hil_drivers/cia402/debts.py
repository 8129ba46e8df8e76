"""Which answers are still to come from earlier cycles, slot by slot."""

from __future__ import annotations

CONFIRMED = 5
"""Cycles in a row with one answer each, soon after the SYNC, that show that the rest was lost."""

STRICT_FROM = 2
"""Answers owed from which on nothing is taken for fresh before they have come or are shown lost."""


class Debts:
    """Answers that had not come when their cycle was over.

    One that is owed alone may be a frame that was lost: the next cycle shows it. Where several are
    owed a drive or a computer stood still, and the first that come belong to older SYNCs. Such a
    slot is strict until all have come, or until its drive has answered `CONFIRMED` times in a row
    as if nothing were left.
    """

    def __init__(self) -> None:
        self._owed: dict[int, int] = {}
        self._single: dict[int, int] = {}
        self._came: dict[int, tuple[int, float]] = {}

    def __bool__(self) -> bool:
        return bool(self._owed)

    def __len__(self) -> int:
        return len(self._owed)

    @property
    def slots(self) -> list[int]:
        """Slots that owe answers."""
        return list(self._owed)

    @property
    def watched(self) -> bool:
        """Whether any slot is strict: all its frames are to be told to `came`."""
        return bool(self._single)

    def owe(self, slot: int) -> None:
        """The answer to the SYNC of a cycle that is over has not come."""
        owed = self._owed[slot] = self._owed.get(slot, 0) + 1
        if owed >= STRICT_FROM:
            self._single.setdefault(slot, 0)

    def pay(self, slot: int) -> bool:
        """An answer of an earlier cycle has come; False when none was owed."""
        owed = self._owed.pop(slot, 0)
        if owed > 1:
            self._owed[slot] = owed - 1
        elif slot in self._single:
            del self._single[slot]
        return owed > 0

    def forget_lost(self) -> None:
        """Those that are owed alone were lost."""
        for slot in self.slots:
            if slot not in self._single:
                del self._owed[slot]

    def came(self, slot: int, now_s: float) -> None:
        """A frame has come while the answers to a SYNC were waited for."""
        number, first_s = self._came.get(slot, (0, now_s))
        self._came[slot] = number + 1, first_s

    def came_between(self, slot: int) -> None:
        """A frame has come when its cycle was over: answers are late, none of them was lost."""
        if slot in self._single:
            self._single[slot] = 0

    def confirm(self, soon_s: float) -> None:
        """A cycle is over: strict slots that answered it once, and soon, may have lost the rest.

        Args:
            soon_s: Until when answers usually come, in the time of `came`.
        """
        for slot, in_a_row in list(self._single.items()):
            number, first_s = self._came.get(slot, (0, 0.0))
            once = number == 1 and first_s <= soon_s
            self._single[slot] = in_a_row + 1 if once else 0
            if self._single[slot] >= CONFIRMED:
                del self._single[slot], self._owed[slot]
        self._came.clear()
