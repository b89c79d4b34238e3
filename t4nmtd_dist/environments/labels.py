"""True propositions, from a labelling function or the environment's own report."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.opening import import_function
from t4nmtd_dist.environments.user_errors import described

REPORTED = "info['labels']"


class LabelReader:
    """Reads the true propositions after a step.

    Args:
        config: the section ``[environment]``; ``labels`` names the function, if any.
        propositions: all that may be reported.

    Raises:
        EnvError: if the function cannot be imported.
    """

    def __init__(self, config: EnvironmentConfig, propositions: Iterable[str]) -> None:
        self.propositions = tuple(propositions)
        self.source = config.labels or REPORTED
        self._known = frozenset(self.propositions)
        self._rows: dict[frozenset[str], NDArray[np.bool_]] = {}
        self._function: Callable[[Any, dict[str, Any]], Any] | None = None
        if config.labels:
            self._function = import_function(config.labels, config, "environment.labels")

    def row(self, observation: Any, info: dict[str, Any]) -> NDArray[np.bool_]:
        """The true propositions as bool [P], in the order of ``propositions``.

        Returns:
            A read-only array, shared by equal sets.

        Raises:
            EnvError: if the function raises, or the labels are not a set of declared names.
        """
        found = self._found(observation, info)
        row = self._rows.get(found) if isinstance(found, frozenset) else None
        if row is None:
            names = self._checked(found)
            row = self._rows[names] = np.array([name in names for name in self.propositions], dtype=np.bool_)
            row.flags.writeable = False
        return row

    def _checked(self, found: Any) -> frozenset[str]:
        if isinstance(found, str | bytes) or not isinstance(found, Iterable):
            raise EnvError(f"{self.source} gave {found!r}; expected a set of names out of {self._declared}")
        try:
            names = frozenset(found)
        except TypeError:
            raise EnvError(f"{self.source} gave {found!r}; expected a set of names") from None
        if not names <= self._known:
            strange = next(iter(names - self._known))
            raise EnvError(
                f"{self.source} reported {strange!r}, which is not declared; "
                f"propositions declares {self._declared}: add it there, or do not report it"
            )
        return names

    def _found(self, observation: Any, info: dict[str, Any]) -> Any:
        if self._function is None:
            if "labels" not in info:
                raise EnvError(
                    "the environment's info has no 'labels' and the task names no labelling function; "
                    'add environment.labels = "module:function"'
                )
            return info["labels"]
        try:
            return self._function(observation, info)
        except Exception as error:  # user code may raise anything
            raise EnvError(f"labelling function {self.source} raised {described(error)}") from error

    @property
    def _declared(self) -> str:
        return ", ".join(self.propositions) or "nothing"
