"""Model files of networks that are damaged: one error that names the file, quickly, or a model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

from hil.core.errors import DataError, FitError, HilError, PluginError
from hil.estimators import load_model_file, save_model
from tests.support.bad_networks import NETWORKS, fitted
from tests.support.fuzzing import damaged, examples, quick_folder
from tests.support.synthetic_motion import moving

torch = pytest.importorskip("torch", reason="torch is not installed")

KINDS = sorted(NETWORKS)
kinds = pytest.mark.parametrize("kind", KINDS)


@cache
def stored(kind: str) -> tuple[bytes, bytes]:
    """Both files of a model."""
    with quick_folder() as folder:
        save_model(fitted(kind), folder / "model")
        return tuple(
            (folder / "model" / name).read_bytes() for name in ("model.json", "model.safetensors")
        )


def outcome(document: bytes, arrays: bytes) -> HilError | None:
    """What loading and predicting end with; anything but an error of hil fails the test."""
    with quick_folder() as folder:
        (folder / "model.json").write_bytes(document)
        (folder / "model.safetensors").write_bytes(arrays)
        try:
            model = load_model_file(folder)
            with np.errstate(all="ignore"):
                model.predict(moving(9, samples=30))
        except (DataError, FitError, PluginError) as error:
            return error
    return None


def refusal(document: bytes, arrays: bytes) -> HilError:
    error = outcome(document, arrays)
    assert isinstance(error, DataError)
    assert "/model." in error.message
    assert error.hint
    return error


def sealed(kind: str, arrays: bytes) -> tuple[bytes, bytes]:
    """Arrays with a document that vouches for them."""
    document = json.loads(stored(kind)[0])
    digest = hashlib.sha256(arrays).hexdigest()
    return json.dumps(document | {"arrays_sha256": digest}).encode(), arrays


def changed(kind: str, *way: Any, to: Any) -> bytes:
    """The document with one value replaced."""
    document = json.loads(stored(kind)[0])
    at = document
    for key in way[:-1]:
        at = at[key]
    at[way[-1]] = to
    return json.dumps(document).encode()


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_file_that_ends_early_is_told(kind: str, share: float) -> None:
    document, arrays = stored(kind)
    refusal(document[: int(share * len(document))], arrays)
    refusal(document, arrays[: int(share * len(arrays))])
    refusal(*sealed(kind, arrays[: int(share * len(arrays))]))


@kinds
def test_any_flipped_bit_of_the_arrays_is_found(kind: str) -> None:
    document, arrays = stored(kind)
    for place in range(0, len(arrays), max(1, len(arrays) // 40)):
        flipped = bytearray(arrays)
        flipped[place] ^= 1 << place % 8
        assert "damaged" in refusal(document, bytes(flipped)).message


@kinds
@pytest.mark.parametrize("version", [2, 10**30, 0, -1, True, "1", None, 1.0])
def test_only_the_format_there_is_is_read(kind: str, version: object) -> None:
    refusal(changed(kind, "hil_model", to=version), stored(kind)[1])


def spoilt(values: np.ndarray) -> Iterator[tuple[str, np.ndarray | None]]:
    yield "gone", None
    yield "longer", np.concatenate([values, values])
    yield "empty", values[:0]
    yield "deeper", values[None]
    yield "true or false", values.astype(bool)
    if values.dtype.kind == "f":
        yield "NaN", np.full_like(values, np.nan)
        yield "infinite", np.full_like(values, np.inf)


@pytest.mark.thorough
@kinds
def test_no_array_may_be_missing_misshapen_or_without_numbers(kind: str) -> None:
    arrays = load(stored(kind)[1])
    for name in sorted(_one_of_each(arrays)):
        for how, values in spoilt(arrays[name]):
            unknown = name.endswith("f_cut_hz") or (how == "NaN" and name.endswith("sigma"))
            single = values is not None and arrays[name].size == 1 and how in ("longer", "deeper")
            smooth = how == "gone" and name == "length"
            if name == "training_rows" or unknown or single or smooth:
                continue
            broken = {k: v for k, v in arrays.items() if k != name}
            if values is not None:
                broken[name] = np.ascontiguousarray(values)
            assert outcome(*sealed(kind, save(broken))) is not None, (name, how)


def _one_of_each(arrays: dict[str, np.ndarray]) -> list[str]:
    """Names that differ by more than a number."""
    by_kind = {"".join(c for c in name if not c.isdigit()): name for name in arrays}
    return list(by_kind.values())


@kinds
@pytest.mark.parametrize("dtype", ["bfloat16", "complex64"])
def test_numbers_that_numpy_does_not_have_are_refused(kind: str, dtype: str) -> None:
    from safetensors.torch import save as save_tensors

    tensors = {k: torch.as_tensor(v.copy()) for k, v in load(stored(kind)[1]).items()}
    tensors["sigma"] = tensors["sigma"].to(getattr(torch, dtype))
    refusal(*sealed(kind, save_tensors(tensors)))


def test_places_in_a_matrix_follow_from_the_design() -> None:
    arrays = load(stored("dissipative")[1])
    for places in (arrays["network.friction.places"] + 30, -arrays["network.friction.places"]):
        error = refusal(*sealed("dissipative", save(arrays | {"network.friction.places": places})))
        assert "places" in error.message


def test_a_length_is_above_zero() -> None:
    arrays = load(stored("memory")[1])
    for length in (0.0, -1.0, np.inf):
        broken = arrays | {"length": np.full_like(arrays["length"], length)}
        assert "length" in refusal(*sealed("memory", save(broken))).message


@pytest.mark.parametrize(
    ("kind", "way", "to"),
    [
        ("lagrangian", ("fitted", "design", "network", "hidden"), [4096] * 16),
        ("lagrangian", ("fitted", "design", "network", "hidden"), [10**12, 10**12]),
        ("dissipative", ("fitted", "design", "friction", "hidden"), [10**9, 10**9]),
        ("dissipative", ("fitted", "design", "friction", "hidden"), [4096] * 4096),
        ("dissipative", ("fitted", "design", "friction", "rest_speed"), 10**400),
        ("residual", ("fitted", "networks"), 10**9),
        ("residual", ("fitted", "networks"), 1e308),
        ("residual", ("fitted", "residual", "dilations"), [10**9, 4]),
        ("residual", ("fitted", "residual", "dilations"), [1, 1e308]),
        ("residual", ("fitted", "residual", "kernel"), 10**12),
        ("residual", ("fitted", "residual", "channels"), 10**12),
        ("residual", ("fitted", "residual", "latency_s"), 1e300),
        ("on a network", ("fitted", "base", "fitted", "design", "network", "hidden"), [4096] * 16),
    ],
)
def test_absurd_sizes_are_refused_before_they_take_up_memory(kind, way, to, monkeypatch) -> None:
    def enormous(*args: object, **kwargs: object) -> None:
        raise AssertionError("a network was built")

    monkeypatch.setattr("hil.networks.lagrangian.NetworkModel", enormous)
    refusal(changed(kind, *way, to=to), stored(kind)[1])


@kinds
def test_whole_numbers_that_a_file_has_with_a_point_are_read(kind: str) -> None:
    document = changed(kind, "parameters", "training", "epochs", to=1.0)
    assert outcome(document, stored(kind)[1]) is None


FITTING = {"samples": [3], "margin": [3], "filters": [{}], "coverage": [{}, []]}
"""What is as good by fact: another number, filters by default, nothing known of the bands."""


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("to", [None, {}, [], "x", 3])
def test_facts_of_another_kind_are_refused(kind: str, to: object) -> None:
    facts = json.loads(stored(kind)[0])["fitted"]
    for key in facts.keys() - {"friction", "gains_source", "notes", "by_sample", "protocol"}:
        error = outcome(changed(kind, "fitted", key, to=to), stored(kind)[1])
        assert (error is None) == (to in FITTING.get(key, ())), key


@pytest.mark.thorough
@kinds
@examples(12)
@given(data=st.data())
def test_any_damaged_document_is_refused_or_read(kind: str, data: st.DataObject) -> None:
    document = data.draw(damaged([json.loads(stored(kind)[0])]))
    outcome(json.dumps(document).encode("utf-8", "surrogatepass"), stored(kind)[1])


@kinds
@examples(12)
@given(data=st.data())
def test_bytes_replaced_in_either_file_are_refused_or_read(kind: str, data: st.DataObject) -> None:
    def torn(content: bytes) -> bytes:
        start = data.draw(st.integers(0, len(content)))
        end = data.draw(st.integers(start, min(start + 20, len(content))))
        return content[:start] + data.draw(st.binary(max_size=12)) + content[end:]

    document, arrays = stored(kind)
    outcome(torn(document), arrays)
    outcome(*sealed(kind, torn(arrays)))


def test_the_error_names_the_folder(tmp_path: Path) -> None:
    folder = save_model(fitted("lagrangian"), tmp_path / "model")
    (folder / "model.safetensors").unlink()
    with pytest.raises(DataError, match=r"cannot read .*model\.safetensors") as caught:
        load_model_file(folder)
    assert caught.value.hint
