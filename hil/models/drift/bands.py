"""What each probe was held against: where those of an unchanged robot would lie."""

from __future__ import annotations

from dataclasses import dataclass

from hil.core import FloatArray
from hil.models.drift.chart import Charted, charted
from hil.models.drift.history import Probe, probes_of, quiet_like
from hil.models.model_registry import Registry


@dataclass(frozen=True, slots=True, eq=False)
class Banded:
    """A probe, and what the charts expected of it.

    Attributes:
        probe: As it was judged.
        chart: Of it and those of its program before it under the same champion.
    """

    probe: Probe
    chart: Charted

    @property
    def expected(self) -> FloatArray:
        """(K,) of an unchanged robot at this probe's temperature."""
        return self.probe.features.values - self.chart.deviation

    @property
    def chance(self) -> float:
        """Bound of the probability that an unchanged robot shows as much, anywhere.

        Below the probe's false alarm rate the probe is called changed.
        """
        return min(1.0, 2.0 * len(self.probe.features.names) * self.probe.p)


def banded(registry: Registry, name: str) -> list[Banded]:
    """All probes of a name with what they were held against, in the order they were judged in.

    Raises:
        RegistryError: There is no such name, or its history or one of the champions is damaged.
        DataError: A champion cannot be read.
    """
    probes = probes_of(registry, name)
    sigma = {
        number: registry.load(name, f"v{number}").sigma_
        for number in {probe.champion for probe in probes}
    }
    found: list[Banded] = []
    for probe in probes:
        quiet = quiet_like((one.probe for one in found), probe.champion, probe.program)
        features = [*(one.features for one in quiet), probe.features]
        chart = charted(features, sigma[probe.champion], probe.false_alarm)
        found.append(Banded(probe, chart))
    return found
