"""Whatever a file holds: a spec or a SpecError, in bounded time, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hil.core.errors import SpecError
from hil.core.yaml import parse, scalar
from hil.spec import load_station, spec_from_text, spec_hash
from tests.support.fuzzing import examples
from tests.support.paths import EXPERIMENTS

SHIPPED = [path.read_text("utf-8") for path in sorted((EXPERIMENTS).glob("*.yaml"))]
STATION = (EXPERIMENTS / "stations" / "mock.yaml").read_text("utf-8")

bounded = examples(30)

yaml_like = st.text(alphabet="ab:01.-e \n\t[]{},&*!|>?'\"#%@~<_x", max_size=200)
plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["ur5", "dwell", "fourier", "95 ms", "1e-3", "static-wls", "speed"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.text(max_size=5)
            | st.sampled_from(["kind", "mass_kg", "estimator", "max", "unit", "loads", "copy"]),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


def refusal(load: Callable[[], object]) -> list[str]:
    """The lines of the SpecError that loading ends with; none where it succeeds."""
    try:
        load()
    except SpecError as error:
        return str(error).partition("\n  →")[0].splitlines()
    return []


def assert_spec_or_refusal(text: str) -> None:
    said = refusal(lambda: spec_hash(spec_from_text(text, "f")))

    assert all(line.startswith(("f:", "… and ")) for line in said)
    assert "\n".join(said).encode("utf-8") is not None


@bounded
@given(st.binary(max_size=300))
def test_random_bytes(raw: bytes) -> None:
    said = refusal(lambda: parse(raw, "f"))

    assert all(line.startswith("f:") for line in said)


@bounded
@given(st.text(max_size=200) | yaml_like)
def test_random_text(text: str) -> None:
    assert_spec_or_refusal(text)


@bounded
@given(yaml_like)
def test_random_text_below_a_good_beginning(text: str) -> None:
    assert_spec_or_refusal("hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: dwell}\n" + text)


@bounded
@given(st.sampled_from([*SHIPPED, STATION]), st.data())
def test_shipped_files_with_a_piece_replaced(text: str, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(start + 30, len(text))))

    assert_spec_or_refusal(text[:start] + data.draw(yaml_like) + text[end:])


def paths_in(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    children = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [path] * bool(path) + [p for k, v in children for p in paths_in(v, (*path, k))]


@pytest.mark.thorough
@bounded
@given(st.sampled_from(SHIPPED), plain, st.data())
def test_shipped_experiments_with_any_value_replaced(
    text: str, value: Any, data: st.DataObject
) -> None:
    raw = parse(text, "f").data
    path = data.draw(st.sampled_from(paths_in(raw)))
    target = raw
    for step in path[:-1]:
        target = target[step]
    target[path[-1]] = value

    assert_spec_or_refusal(yaml.safe_dump(raw, allow_unicode=True))


@pytest.mark.thorough
@bounded
@given(plain, st.data())
def test_stations_with_any_value_replaced(
    tmp_path_factory: Any, value: Any, data: st.DataObject
) -> None:
    raw = parse(STATION, "f").data
    path = data.draw(st.sampled_from(paths_in(raw)))
    target = raw
    for step in path[:-1]:
        target = target[step]
    target[path[-1]] = value
    file = tmp_path_factory.getbasetemp() / "station.yaml"
    file.write_text(yaml.safe_dump(raw, allow_unicode=True), "utf-8", errors="replace")

    said = refusal(lambda: load_station(file))

    assert all(line.startswith((str(file), "…")) for line in said)


@bounded
@given(
    st.dictionaries(st.text(alphabet="aehlnmorsx.01", max_size=12), yaml_like, max_size=3),
)
def test_random_overrides(overrides: dict[str, str]) -> None:
    said = refusal(lambda: spec_from_text(SHIPPED[0], "f", overrides))

    assert all(line.startswith(("f:", "--set ", "… and ")) for line in said)


@bounded
@given(st.none() | st.booleans() | st.integers(1 - 2**63, 2**63 - 1) | st.floats(allow_nan=False))
def test_what_pyyaml_writes_is_read_back_as_the_same_value(value: object) -> None:
    assert scalar(yaml.safe_dump(value, default_flow_style=True)) == value
