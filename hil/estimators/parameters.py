"""Declaration and validation of the parameters of estimators and studies.

A class declares its parameters like the fields of a dataclass, each with a check, limits and a
description:

    class RigidWls(RigidLinear):
        sign_width: float = parameter(0.01, number, at_least=0.0, doc="Width of the tanh [rad/s].")
        weighted: bool = parameter(True, flag, doc="Weight the joints by their residual.")

`Parametrised` creates the constructor from the declared parameters: all parameters are keywords,
and all values are checked. The constructor has a signature and an `Args` section for `help`.
`Parametrised` also provides `get_params` and `set_params` of scikit-learn without importing
scikit-learn. A subclass lists its own parameters first and inherits the parameters of its bases. A
subclass that assigns a plain value to a parameter (`form = "shared"`) removes this parameter. The
method `_check_together` checks conditions that involve several parameters.

A class can also define a constructor instead of declaring parameters. The keywords of a
user-defined constructor are the parameters, and each must be stored in an attribute of the same
name. A class with a user-defined constructor must not declare parameters with `parameter`, because
this constructor would ignore them; the class definition raises TypeError.

The checks (`number`, `whole`, `share`, `flag`, `choice`, `mapping`, `settings`) take the name and
the value of a parameter, return the value to be stored and raise `SpecError` with that name.
`as_given` accepts every value, so that `_check_together` can check the parameter.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ValidationError

from hil.core import SpecError, did_you_mean

MOST_SEED = 2**32 - 1
"""Largest seed that every supported random generator accepts."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Declaration of one parameter of an estimator or study.

    Attributes:
        default: Default value as shown in the signature; the check is applied to the default too.
        check: Function that takes the parameter name and a value, and returns the value to be
            stored.
        doc: Description of the parameter, with its unit.
    """

    default: Any
    check: Callable[[str, Any], Any]
    doc: str


def parameter(
    default: Any,
    check: Callable[..., Any],
    *args: Any,
    doc: str,
    optional: bool = False,
    **limits: Any,
) -> Any:
    """Declare a parameter of a `Parametrised` class.

    Args:
        default: Default value of the parameter.
        check: One of the check functions of this module.
        *args: Positional arguments of the check function that follow name and value.
        doc: Description of the parameter, with its unit.
        optional: Whether None is also allowed; None is stored without a check.
        **limits: Keyword arguments of the check function.
    """

    def checked(name: str, value: Any) -> Any:
        return None if optional and value is None else check(name, value, *args, **limits)

    return Parameter(default, checked, doc)


class Parametrised:
    """Base class with keyword-only constructor parameters that can be read, changed and stored."""

    _declared: ClassVar[dict[str, Parameter]] = {}
    __signature__: ClassVar[inspect.Signature]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # Names of the class come first and hide declarations of its bases with the same name.
        own: dict[str, Any] = {}
        for base in cls.__mro__:
            own = own | {name: value for name, value in vars(base).items() if name not in own}
        cls._declared = {n: each for n, each in own.items() if isinstance(each, Parameter)}
        cls._refuse_unread_parameters()
        cls.__signature__ = cls._signature()
        if cls._declared and "Args:" not in (cls.__doc__ or "") and "__doc__" in vars(cls):
            lines = "".join(f"    {name}: {each.doc}\n" for name, each in cls._declared.items())
            cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\nArgs:\n{lines}"

    @classmethod
    def _refuse_unread_parameters(cls) -> None:
        """Raise TypeError if the class declares parameters that its constructor does not read."""
        # Parameters of a parametrised base do not count, because the constructor may have set them.
        own = [base for base in cls.__mro__ if base is cls or not issubclass(base, Parametrised)]
        ignored = [
            name for base in own for name, each in vars(base).items() if isinstance(each, Parameter)
        ]
        if not ignored or cls.__init__ is Parametrised.__init__:
            return
        by = next(base.__qualname__ for base in cls.__mro__ if "__init__" in vars(base))
        raise TypeError(
            f"{cls.__qualname__} declares {', '.join(ignored)} with parameter(...), which the "
            f"constructor {by}.__init__ ignores: remove that constructor, or make them its "
            "keywords instead"
        )

    def __init__(self, **params: Any) -> None:
        require_known(params, tuple(self._declared), type(self).__name__)
        for name, each in self._declared.items():
            setattr(self, name, each.check(name, params.get(name, each.default)))
        self._check_together()

    def _check_together(self) -> None:
        """Raise SpecError if parameter values that are valid separately contradict each other."""

    @classmethod
    def _signature(cls) -> inspect.Signature:
        """Return the signature of the declared parameters, or of a user-defined constructor."""
        if cls.__init__ is not Parametrised.__init__:
            own = inspect.signature(cls.__init__)
            return own.replace(parameters=list(own.parameters.values())[1:])
        keyword = inspect.Parameter.KEYWORD_ONLY
        declared = cls._declared.items()
        return inspect.Signature(
            [inspect.Parameter(name, keyword, default=each.default) for name, each in declared]
        )

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Return the names of the constructor parameters."""
        return tuple(inspect.signature(cls).parameters)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the parameters by name; `deep` exists for compatibility with scikit-learn."""
        return {name: getattr(self, name) for name in self.parameter_names()}

    def set_params(self, **params: Any) -> Self:
        """Change parameters and return the estimator, which must then be fitted again.

        Raises:
            SpecError: A parameter is unknown or its value is invalid; in this case, no parameter is
                changed.
        """
        require_known(params, self.parameter_names(), type(self).__name__)
        checked = type(self)(**{**self.get_params(), **params})
        for name, value in checked.get_params().items():
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        inside = ", ".join(f"{name}={value!r}" for name, value in self.get_params().items())
        return f"{type(self).__name__}({inside})"


Settings = TypeVar("Settings", bound=BaseModel)


def as_given(name: str, value: Any) -> Any:
    """Return the parameter value unchanged and unchecked."""
    return value


def number(
    name: str,
    value: Any,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return the parameter value as a finite float within its limits.

    Raises:
        SpecError: The value is not a finite number within the limits; the message names the
            parameter.
    """
    limits = [f"at least {at_least:g}"] if at_least is not None else []
    limits += [f"above {above:g}"] if above is not None else []
    limits += [f"at most {at_most:g}"] if at_most is not None else []
    checked = _float(value)
    if (
        not math.isfinite(checked)
        or (at_least is not None and checked < at_least)
        or (above is not None and checked <= above)
        or (at_most is not None and checked > at_most)
    ):
        wanted = " and ".join(limits)
        raise SpecError(f"{name} is {value!r:.60}, but must be a number {wanted}".rstrip())
    return checked


def _float(value: Any) -> float:
    """Return the value as a float; NaN if it is not a real number or exceeds the float range."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _integral(value: Any) -> Any:
    """Return a whole number of any type as an int; return any other value unchanged.

    Pydantic then rejects the unchanged value if it is not a whole number.
    """
    return int(value) if _float(value).is_integer() else value


Whole = Annotated[int, BeforeValidator(_integral)]
"""Integer type for the validation of strict settings.

The type accepts 60, the 60.0 of a file and whole numbers of numpy, but neither True nor "60".
"""


def share(name: str, value: Any) -> float:
    """Return the value as a float above 0 and below 1.

    Raises:
        SpecError: The value is not a number between 0 and 1; the message names the parameter.
    """
    checked = number(name, value, above=0.0)
    if checked >= 1.0:
        hint = f"{checked / 100:g}, if it is in percent" if 1.0 < checked < 100.0 else "0.5 is half"
        raise SpecError(f"{name} is {checked:g}, but must be a share below 1", hint=hint)
    return checked


def flag(name: str, value: Any) -> bool:
    """Return the value if it is True or False.

    Raises:
        SpecError: The value is not a bool; the message names the parameter.
    """
    if not isinstance(value, bool):
        raise SpecError(f"{name} is {value!r}, but must be true or false")
    return value


def choice(name: str, value: Any, known: Sequence[str]) -> Any:
    """Return the value if it is one of the known values.

    Raises:
        SpecError: The value is not in `known`; the message names the parameter.
    """
    if value not in known:
        listed = " or ".join(repr(word) for word in known)
        hint = did_you_mean(value, known) if isinstance(value, str) else ""
        raise SpecError(f"{name} is {value!r}, but must be {listed}", hint=hint)
    return value


def mapping(name: str, value: Any) -> dict[str, Any]:
    """Return a mapping with string keys as a dict; return an empty dict for None.

    Raises:
        SpecError: The value is not a mapping with string keys.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise SpecError(
            f"{name} is {value!r:.60}, but must be a mapping of names to values",
            hint=f"{name}: {{NAME: VALUE}}",
        )
    return dict(value)


def settings(name: str, value: Any, kind: type[Settings]) -> Settings:
    """Return a settings object, created from a dict if necessary; return the defaults for None.

    Raises:
        SpecError: The settings are invalid; the message names the parameter and the key.
    """
    try:
        return kind.model_validate({} if value is None else value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
            require_known({str(first["loc"][0]): None}, tuple(kind.model_fields), name)
        where = ".".join((name, *(str(part) for part in first["loc"])))
        raise SpecError(f"{where}: {first['msg']}") from error


def require_known(given: dict[str, Any], known: tuple[str, ...], of: str) -> None:
    """Raise if a parameter name is unknown; the message lists the known names.

    Raises:
        SpecError: A parameter name is not among the known names.
    """
    for name in given:
        if name not in known:
            raise SpecError(
                f"{of} has no parameter {name!r} (it has {', '.join(known) or 'none'})",
                hint=did_you_mean(name, known),
            )


def whole(name: str, value: Any, *, at_least: int, at_most: float | None = None) -> int:
    """Return the parameter value as an int within its limits.

    Raises:
        SpecError: The value is not a whole number within the limits; the message names the
            parameter.
    """
    number(name, value, at_least=at_least, at_most=at_most)
    if int(value) != value:
        raise SpecError(f"{name} is {value!r}, but must be a whole number")
    return int(value)
