"""Registries: names usable in a configuration, and the modules that implement them.

To add a method, an agent or a launcher, write its module (or folder) and add one line here. Modules are imported on
first use.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from t4nmtd_dist.core.errors import ConfigError


@dataclass(frozen=True)
class Registry:
    """Names and their modules.

    Attributes:
        kind: what is registered, for messages; "agent".
        modules: name -> dotted module name.
    """

    kind: str
    modules: Mapping[str, str]

    def names(self) -> tuple[str, ...]:
        """All names, sorted."""
        return tuple(sorted(self.modules))

    def check(self, name: str, setting: str) -> None:
        """Check that ``name``, the value of ``setting``, is registered.

        Raises:
            ConfigError: lists the known names and suggests the nearest.
        """
        if name in self.modules:
            return
        near = difflib.get_close_matches(name, self.modules, n=1)
        advice = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(f"{setting}: unknown {self.kind} {name!r}; {advice}Known: {', '.join(self.names())}")

    def module(self, name: str, part: str = "") -> ModuleType:
        """Import the module of ``name``, or its submodule ``part``.

        Raises:
            ConfigError: if the name is unknown.
        """
        self.check(name, self.kind)
        dotted = self.modules[name]
        return import_module(f"{dotted}.{part}" if part else dotted)


# ``learner.algorithm = "auto"`` chooses the first that supports the environment's actions.
AGENTS = Registry(
    "agent",
    {
        "ppo": "t4nmtd_dist.agents.ppo",
        "sac": "t4nmtd_dist.agents.sac",
        "dqn": "t4nmtd_dist.agents.dqn",
    },
)

METHODS = Registry(
    "method",
    {
        "crm": "t4nmtd_dist.method.crm",
        "dirl": "t4nmtd_dist.method.dirl",
        "hdqn": "t4nmtd_dist.method.hdqn",
        "hrm": "t4nmtd_dist.method.hrm",
        "lsts": "t4nmtd_dist.method.lsts",
        "mod": "t4nmtd_dist.method.mod",
        "product": "t4nmtd_dist.method.product",
        "qrm": "t4nmtd_dist.method.qrm",
        "random": "t4nmtd_dist.method.random_decomposition",
        "t4nmtd": "t4nmtd_dist.method.t4nmtd",
    },
)

LAUNCHERS = Registry(
    "launcher",
    {
        "forked": "t4nmtd_dist.launch.forked",
        "local": "t4nmtd_dist.launch.local",
        "serial": "t4nmtd_dist.launch.serial_launcher",
    },
)
