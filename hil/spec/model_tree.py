"""What a model allows at a place: walks pydantic models by the keys of the file.

Pydantic's error locations hold the tag of a discriminated union (`excitation.dwell.dwell_s`),
which no file contains; walking the models is how the tag is told from a key of the same name.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from hil.core import KeyPath

Model = type[BaseModel]


def keys_of(model: Model) -> dict[str, FieldInfo]:
    """The keys a file may use for a model: aliases where a field has one."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def plain(annotation: Any) -> Any:
    """An annotation without `Annotated` and without `| None`."""
    if get_origin(annotation) is Annotated:
        return plain(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        rest = [arg for arg in get_args(annotation) if arg is not type(None)]
        return plain(rest[0]) if len(rest) == 1 else annotation
    return annotation


def kinds_of(annotation: Any) -> dict[str, Model]:
    """The models of a discriminated union by the value of their `kind`; empty for all else."""
    members = [plain(arg) for arg in get_args(plain(annotation))]
    if get_origin(plain(annotation)) not in (Union, types.UnionType):
        return {}
    return {kind: model for model in members if is_model(model) for kind in _kind_values(model)}


def is_model(annotation: Any) -> bool:
    """True for a pydantic model class."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def choices_of(annotation: Any) -> tuple[Any, ...]:
    """The values of a `Literal`, empty for all else."""
    inner = plain(annotation)
    return get_args(inner) if get_origin(inner) is Literal else ()


def locate(model: Model, loc: tuple[str | int, ...]) -> tuple[KeyPath, Any]:
    """Turn pydantic's location into the path in the file and what is expected there.

    Returns:
        The path without union tags, and the annotation at it (None where the model says nothing,
        as below an unknown key).
    """
    path: list[str | int] = []
    place: Any = model
    for step in loc:
        kinds = kinds_of(place)
        if step in kinds:
            place = kinds[str(step)]
        elif step != "[key]":
            path.append(step)
            place = _below(plain(place), step)
    return tuple(path), place


def nested(annotation: Any) -> Iterator[Model]:
    """The models a value of this annotation can hold directly, through tuples and dicts."""
    inner = plain(annotation)
    if is_model(inner):
        yield inner
    elif get_origin(inner) is not Literal:
        for arg in get_args(inner):
            yield from nested(arg)


def tree(model: Model, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Model]]:
    """Every model that can occur in a file, with its path, from the top downwards.

    Items of a list are not told apart (`loads`), entries of a dict are called by `<name>`.
    """
    yield path, model
    for key, field in keys_of(model).items():
        is_dict = get_origin(plain(field.annotation)) is dict
        for inner in nested(field.annotation):
            yield from tree(inner, (*path, key, "<name>") if is_dict else (*path, key))


def _below(place: Any, step: str | int) -> Any:
    if is_model(place):
        field = keys_of(place).get(str(step))
        return field.annotation if field else None
    args = get_args(place)
    if get_origin(place) is dict:
        return args[1]
    if get_origin(place) is tuple and isinstance(step, int):
        return args[0] if Ellipsis in args else args[min(step, len(args) - 1)]
    return None


def _kind_values(model: Model) -> tuple[str, ...]:
    field = model.model_fields.get("kind")
    return choices_of(field.annotation) if field else ()


def key_above(path: KeyPath, model: Model) -> KeyPath:
    """The deepest key that a file of the model may have at a place or above it.

    List indices are left out; entries of a dict go by any name, whose place is not a key itself.
    """
    known = [(*above, key) for above, owner in tree(model) for key in keys_of(owner)]
    steps = tuple(step for step in path if isinstance(step, str))
    for length in range(len(steps), 0, -1):
        begun = steps[:length]
        for one in known:
            if len(one) == length and all(
                a in (b, "<name>") for a, b in zip(one, begun, strict=True)
            ):
                return begun
    return ()
