"""Constructor parameters the scikit-learn way, without importing scikit-learn."""

from __future__ import annotations

import inspect
from typing import Any, Self

from hil.errors import SpecError
from hil.suggest import did_you_mean


class Parametrised:
    """Keyword-only constructor parameters that can be read, set and stored.

    A subclass assigns every parameter to an attribute of the same name and does nothing else in
    its constructor.
    """

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Names of the constructor's parameters."""
        signature = inspect.signature(cls)
        return tuple(signature.parameters)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The parameters as given; `deep` is there for scikit-learn's sake."""
        return {name: getattr(self, name) for name in self.parameter_names()}

    def set_params(self, **params: Any) -> Self:
        """Change parameters; the estimator must be fitted again.

        Raises:
            SpecError: There is no such parameter.
        """
        require_known(params, self.parameter_names(), type(self).__name__)
        for name, value in params.items():
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        inside = ", ".join(f"{name}={value!r}" for name, value in self.get_params().items())
        return f"{type(self).__name__}({inside})"


def require_known(given: dict[str, Any], known: tuple[str, ...], of: str) -> None:
    """Refuse parameters nobody knows, naming those that exist.

    Raises:
        SpecError: A given parameter is not among the known ones.
    """
    for name in given:
        if name not in known:
            raise SpecError(
                f"{of} has no parameter {name!r} (it has {', '.join(known) or 'none'})",
                hint=did_you_mean(name, known),
            )
