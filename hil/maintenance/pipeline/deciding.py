"""What becomes of the model of an occasion: champion, or kept out; decided once.

That it was decided is looked up where it is done: in the registry's log, whose reason begins with
the occasion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hil.maintenance.pipeline.earlier import earlier_probes
from hil.maintenance.pipeline.stages import Document
from hil.models import Entry, Registry, challenge


def decided(registry: Registry, name: str, key: str, number: int) -> Entry | None:
    """What an occasion has decided already about a version, by the log.

    Args:
        registry: Where the version is.
        name: Whose.
        key: Of the occasion.
        number: The version's.
    """
    mine = (one for one in reversed(registry.log(name)) if one.event in ("promoted", "kept"))
    return next((one for one in mine if one.version == number and one.reason.startswith(key)), None)


@dataclass(frozen=True, slots=True)
class Decision:
    """About the model of an occasion.

    Attributes:
        registry: Where its version is.
        name: Whose.
        key: Of the occasion.
        done: Documents of the stages before.
    """

    registry: Registry
    name: str
    key: str
    done: Mapping[str, Document]

    @property
    def number(self) -> int:
        """Of the challenger."""
        return int(self.done["register"]["version"])

    @property
    def before(self) -> int:
        """Champion when the occasion began, 0 for none."""
        return int(self.done["begin"]["champion"] or 0)

    def made(self) -> Document:
        """`promoted`, `reason` and `evidence`; taken now if it was not before."""
        if self.number == self.before:
            return {"promoted": False, "reason": "it is the champion itself", "evidence": {}}
        about = (self.registry, self.name, self.key, self.number)
        if (entry := decided(*about)) is None:
            self._take()
            entry = decided(*about)
        if entry is None:
            return {"promoted": False, "reason": "it became champion meanwhile", "evidence": {}}
        said = entry.reason.removeprefix(self.key).lstrip(" :")
        promoted = entry.event == "promoted"
        return {"promoted": promoted, "reason": said, "evidence": dict(entry.evidence)}

    def _take(self) -> None:
        judged = self.done["fit"]["criteria"]
        now = self.registry.aliases(self.name).champion
        if missed := [row for row in judged if not row["passed"]]:
            row = missed[0]
            told = f"{row['metric']} of {row['what']} is {row['value']}, at most {row['max']:g}"
            words = f"{len(missed)} criteria of the campaign are missed: {told}"
            self._keep(words, criteria=missed)
        elif now not in (self.before, self.number):
            instead = f", instead of v{self.before}" if self.before else ""
            self._keep(f"v{now} has become champion meanwhile{instead}")
        elif self.before:
            self._challenge()
        else:
            words = "it meets its criteria" if judged else "there are no criteria"
            evidence = {"criteria": judged}
            self.registry.promote(
                self.name, self.number, reason=f"{self._why}: {words}", evidence=evidence,
                instead_of=0,
            )  # fmt: skip

    def _challenge(self) -> None:
        """The campaign's criteria speak of its own held-out motions, and are met there."""
        done = self.done
        taken = [done[stage].get("run") for stage in ("campaign", "probe", "check")]
        earlier: list[Path] = []
        if done["drift"].get("changed") is False:
            earlier = earlier_probes(self.registry, self.name, Path(done["probe"]["run"]))
        challenge(
            self.registry, self.name, f"v{self.number}", [Path(run) for run in taken if run],
            reason=self._why, earlier=earlier,
        )  # fmt: skip

    def _keep(self, words: str, **evidence: object) -> None:
        reason = f"{self._why}: {words}"
        self.registry.keep(self.name, self.number, reason=reason, evidence=evidence)

    @property
    def _why(self) -> str:
        return f"{self.key}: {self.done['campaign']['why']}"
