"""Motions of real robots that pages show, and the confirmation that their forms send back."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from hil.core import HilError, NotConfirmed, SpecError
from hil.dashboard.planning import plan_apart
from hil.dashboard.threads import PLANS
from hil.workflow import digest_of, together

MOST_MOTIONS = 200
"""Plans of real robots whose facts are remembered until they are confirmed."""

NOT_SHOWN = NotConfirmed(
    "not started: a real robot would move, and its motion was not confirmed",
    hint="below is what it would do; type the name of the robot to confirm it",
)

CHANGED = SpecError(
    "not started, for it is not what was checked: the form or a file was changed since",
    hint="below is what would be done now; look at it and start it again",
)


class ShownMotions:
    """The motions that pages have shown, by the digest that their form sends back."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, list[dict[str, Any]]] = OrderedDict()
        self._looking = threading.Lock()

    def keep(self, motions: list[dict[str, Any]]) -> str:
        """Return the digest of motions, `MotionFacts.to_dict` each, and remember them."""
        digest = digest_of({"motions": motions})
        with self._looking:
            self._kept[digest] = motions
            while len(self._kept) > MOST_MOTIONS:
                self._kept.popitem(last=False)
        return digest

    def confirmed(self, digest: str) -> dict[str, Any]:
        """Return what a digest confirms, see `together`; empty where no page has shown it."""
        with self._looking:
            return together(self._kept.get(digest, []))


MOTIONS = ShownMotions()


def refusal_of(given: Mapping[str, str], digest: str, *, real: bool) -> HilError | None:
    """Return why what a form asks for is not started; None where it is.

    Args:
        given: Its fields: `checked`, `facts` and `confirm`.
        digest: Of what would be started now, as `hil.dashboard.checked` makes it.
        real: Whether its motion has to be confirmed.
    """
    if given.get("checked", "") not in ("", digest):
        return CHANGED
    if not real:
        return None
    facts = MOTIONS.confirmed(given.get("facts", ""))
    if facts and not (facts.get("robot") and facts.get("address")):
        robots = {f"{one['robot']} at {one['address']}": None for one in facts["motions"]}
        return NotConfirmed(
            f"not started: it moves {' and '.join(robots)}, and this form confirms one robot",
            hint=f"start it on the command line: hil run {given.get('spec', '')}".rstrip(),
        )
    if not (facts and given.get("checked")):
        return NOT_SHOWN
    if given.get("confirm", "").strip() != facts["robot"]:
        return NotConfirmed(
            f"not started: {facts['robot']} was not confirmed",
            hint=f"look at what it will do, then type {facts['robot']} to confirm it",
        )
    return None


async def plans_to_show(
    asked: Callable[[], Awaitable[Mapping[str, Any]]], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """Plan what a form asks for; nothing moves.

    Args:
        asked: Returns what is to be planned, see `hil.dashboard.planning.plan_apart`.
        gone: Whether the client has left.

    Returns:
        `plans`, and the digests that the form sends back: `checked` of what was planned, `facts`
        of the motions that have to be confirmed, empty where none has to be. Instead of them
        `error` and its HTTP `status` where there is no plan.

    Raises:
        Gone: The client has left.
    """
    if not PLANS.acquire(blocking=False):
        busy = HilError("two plans are being made at the moment", hint="try again in a moment")
        return {"error": busy, "status": 503}
    try:
        answer = await plan_apart(await asked(), gone)
    except HilError as error:
        return {"error": error, "status": 422}
    finally:
        PLANS.release()
    motions = [plan["motion"] for plan in answer["plans"] if plan["motion"]]
    facts = MOTIONS.keep(motions) if motions else ""
    return {"plans": answer["plans"], "checked": answer["digest"], "facts": facts}
