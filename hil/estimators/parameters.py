"""Parameters of estimators and studies: declared in a table, checked in one place.

A class lists its parameters as it lists fields of a dataclass, with the check, the limits and the
meaning of each:

    class RigidWls(RigidLinear):
        sign_width: float = parameter(0.01, number, at_least=0.0, doc="Width of the tanh [rad/s].")
        weighted: bool = parameter(True, flag, doc="Weight the joints by their residual.")

`Parametrised` makes the constructor of them (keywords only, everything checked), with a signature
and an `Args` section for `help`, and scikit-learn's `get_params` and `set_params`, without
importing scikit-learn. A subclass inherits the parameters behind its own; one that assigns a plain
value instead (`form = "shared"`) has no such parameter. What parameters must be together, it checks
in `_check_together`. Classes with a constructor of their own work as well: its keywords are the
parameters, each stored in an attribute of the same name. Such a class cannot declare parameters
too, because its constructor would ignore them: TypeError when the class is made.

The checks (`number`, `whole`, `share`, `flag`, `choice`, `mapping`, `settings`) take the
parameter's name and value, return the value to be stored and raise `SpecError` with that name;
`as_given` leaves a parameter to `_check_together`.
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
"""The largest that every generator of random numbers takes."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A declared parameter.

    Attributes:
        default: As the signature shows it; it is checked like any other value.
        check: From the parameter's name and a value to the value that is stored.
        doc: What it means, with its unit.
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
        default: Its value when it is not given.
        check: One of the checks of this module.
        *args: Of the check, behind name and value.
        doc: What it means, with its unit.
        optional: Whether None is allowed besides, and stored as it is.
        **limits: Keywords of the check.
    """

    def checked(name: str, value: Any) -> Any:
        return None if optional and value is None else check(name, value, *args, **limits)

    return Parameter(default, checked, doc)


class Parametrised:
    """Keyword-only constructor parameters that can be read, set and stored."""

    _declared: ClassVar[dict[str, Parameter]] = {}
    __signature__: ClassVar[inspect.Signature]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # Own names come first, and hide what bases declare under the same name.
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
        # Of a base that is parametrised itself, the constructor may have fixed them.
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
        """Raise SpecError if parameters that are valid one by one exclude each other."""

    @classmethod
    def _signature(cls) -> inspect.Signature:
        """The declared parameters, or those of a constructor that the class or a base has."""
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
        """Names of the constructor's parameters."""
        return tuple(inspect.signature(cls).parameters)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The parameters as given; `deep` is there for scikit-learn's sake."""
        return {name: getattr(self, name) for name in self.parameter_names()}

    def set_params(self, **params: Any) -> Self:
        """Change parameters; the estimator must be fitted again.

        Raises:
            SpecError: There is no such parameter, or it cannot have that value; then nothing has
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
    """Return the value, whatever it is."""
    return value


def number(
    name: str,
    value: Any,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
) -> float:
    """A finite number within its limits.

    Raises:
        SpecError: It is not; the message names the parameter.
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
    """NaN for what is no number, or larger than any."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _integral(value: Any) -> Any:
    """Whole numbers of any kind as an int; all else as it is, for pydantic to refuse."""
    return int(value) if _float(value).is_integer() else value


Whole = Annotated[int, BeforeValidator(_integral)]
"""Of strict settings: 60, 60.0 of a file and whole numbers of numpy, but neither True nor "60"."""


def share(name: str, value: Any) -> float:
    """A number above 0 and below 1.

    Raises:
        SpecError: It is not; the message names the parameter.
    """
    checked = number(name, value, above=0.0)
    if checked >= 1.0:
        hint = f"{checked / 100:g}, if it is in percent" if 1.0 < checked < 100.0 else "0.5 is half"
        raise SpecError(f"{name} is {checked:g}, but must be a share below 1", hint=hint)
    return checked


def flag(name: str, value: Any) -> bool:
    """True or False.

    Raises:
        SpecError: It is neither; the message names the parameter.
    """
    if not isinstance(value, bool):
        raise SpecError(f"{name} is {value!r}, but must be true or false")
    return value


def choice(name: str, value: Any, known: Sequence[str]) -> Any:
    """One of a few words.

    Raises:
        SpecError: It is none of them; the message names the parameter.
    """
    if value not in known:
        listed = " or ".join(repr(word) for word in known)
        hint = did_you_mean(value, known) if isinstance(value, str) else ""
        raise SpecError(f"{name} is {value!r}, but must be {listed}", hint=hint)
    return value


def mapping(name: str, value: Any) -> dict[str, Any]:
    """Settings by name, as a spec has them; None is none.

    Raises:
        SpecError: It is something else.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise SpecError(
            f"{name} is {value!r:.60}, but must be settings by name",
            hint=f"{name}: {{NAME: VALUE}}",
        )
    return dict(value)


def settings(name: str, value: Any, kind: type[Settings]) -> Settings:
    """Settings as they are, or from their dict; None gives the defaults.

    Raises:
        SpecError: They are not valid; the message names the parameter and the key.
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
    """Refuse unknown parameters, naming those that exist.

    Raises:
        SpecError: A given parameter is not among the known ones.
    """
    for name in given:
        if name not in known:
            raise SpecError(
                f"{of} has no parameter {name!r} (it has {', '.join(known) or 'none'})",
                hint=did_you_mean(name, known),
            )


def whole(name: str, value: Any, *, at_least: int, at_most: float | None = None) -> int:
    """Return a whole number of at least and at most so much.

    Raises:
        SpecError: It is not; the message names the parameter.
    """
    number(name, value, at_least=at_least, at_most=at_most)
    if int(value) != value:
        raise SpecError(f"{name} is {value!r}, but must be a whole number")
    return int(value)
