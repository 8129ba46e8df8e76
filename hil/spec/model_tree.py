"""Navigation in pydantic models by the keys of a YAML file.

The error locations of pydantic contain the tag of a discriminated union
(`excitation.dwell.dwell_s`), but the file does not contain this tag. The functions follow the
models to distinguish a union tag from a key with the same name.
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
    """Return the keys that a file may use for a model; the alias of a field replaces its key."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def plain(annotation: Any) -> Any:
    """Return an annotation without the parts `Annotated` and `| None`."""
    if get_origin(annotation) is Annotated:
        return plain(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        rest = [arg for arg in get_args(annotation) if arg is not type(None)]
        return plain(rest[0]) if len(rest) == 1 else annotation
    return annotation


def kinds_of(annotation: Any) -> dict[str, Model]:
    """Return the models of a discriminated union by the value of their `kind`.

    The returned mapping is empty for other annotations.
    """
    members = [plain(arg) for arg in get_args(plain(annotation))]
    if get_origin(plain(annotation)) not in (Union, types.UnionType):
        return {}
    return {kind: model for model in members if is_model(model) for kind in _kind_values(model)}


def is_model(annotation: Any) -> bool:
    """Return whether an annotation is a pydantic model class."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def choices_of(annotation: Any) -> tuple[Any, ...]:
    """Return the values of a `Literal`; empty for other annotations."""
    inner = plain(annotation)
    return get_args(inner) if get_origin(inner) is Literal else ()


def locate(model: Model, loc: tuple[str | int, ...]) -> tuple[KeyPath, Any]:
    """Return the path in the file and the expected annotation for a location from pydantic.

    Returns:
        Path without union tags, and the annotation at this path; the annotation is None if the
        model has none there, for example below an unknown key.
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
    """Yield the models that a value of this annotation can contain.

    The models within tuples and dicts are included.
    """
    inner = plain(annotation)
    if is_model(inner):
        yield inner
    elif get_origin(inner) is not Literal:
        for arg in get_args(inner):
            yield from nested(arg)


def tree(model: Model, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Model]]:
    """Yield every model that can occur in a file, with its path, from top to bottom.

    List items have no index in the path (`loads`); entries of a dict have the name `<name>`.
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
    """Return the path of the deepest valid key of a model at a path or above it.

    List indices are left out of the path. An entry of a dict matches any name, but the entry itself
    does not count as a key.
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
