"""Opens a task's environment: a registered id, ``module:id``, ``module:callable``, or a given object."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym

from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.named_code import code_named
from t4nmtd_dist.environments.task_modules import OUR_WORLDS, explained, import_task_module
from t4nmtd_dist.environments.user_errors import calls, described
from t4nmtd_dist.tasks.given import GIVEN, given, is_given

Env = gym.Env[Any, Any]
Spec = gym.envs.registration.EnvSpec


def open_environment(config: EnvironmentConfig, *, render_mode: str | None = None) -> Env:
    """Open one environment as the task file describes it.

    Keeps the wrappers of a registration, but not those added by ``gymnasium.make``: two checkers and the time limit,
    which the task's ``horizon`` and the learner's attempts replace.

    Args:
        config: the section ``[environment]``.
        render_mode: passed to the constructor, or to a callable that takes it.

    Raises:
        EnvError: if the environment is unknown, cannot be imported, rejects its options, or cannot be rendered.
    """
    spec = find_spec(config)
    maker: Callable[..., Any] = _callable(config) if spec is None else _plain(spec)
    passed_on = render_mode is not None and _takes_render_mode(maker)
    options = {**config.options, **({"render_mode": render_mode} if passed_on else {})}
    env = _called(config, options, maker)
    if not isinstance(env, gym.Env):
        raise EnvError(f"environment {config.id!r} made {type(env).__name__}; expected a gymnasium.Env")
    if render_mode is not None and not passed_on and env.render_mode != render_mode:
        raise EnvError(
            f"environment {config.id!r} cannot be drawn: {config.id.rpartition(':')[2]}() takes no keyword "
            "render_mode; add render_mode=None to its parameters and pass it on to the environment that it makes, or "
            f"let it make that with render_mode={render_mode!r}"
        )
    return env


def _takes_render_mode(maker: Callable[..., Any]) -> bool:
    """Whether a callable takes the keyword; True if unknown."""
    try:
        parameters = inspect.signature(maker).parameters
    except (TypeError, ValueError):
        return True
    return "render_mode" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def find_spec(config: EnvironmentConfig) -> Spec | None:
    """The registration of an id; None for ``module:callable`` or ``python:NAME``.

    Raises:
        EnvError: if there is neither.
    """
    if is_given(config.id):
        return None
    module_name, _, name = config.id.rpartition(":")
    ours = config.id.startswith(OUR_WORLDS)
    place = dataclasses.replace(config, path="") if ours else config
    module = import_module(module_name, place) if module_name else None
    if module is not None and name not in gym.registry and _attribute(module, name) is not None:
        return None
    try:
        return gym.spec(name)
    except gym.error.Error as error:
        also = f"; module {module_name} has no {name!r} either" if module else ""
        raise EnvError(f"environment {config.id!r}: {error}{also}") from None


def import_function(text: str, config: EnvironmentConfig, key: str) -> Callable[..., Any]:
    """The function of a setting ``key = "module:function"``, searched in ``config.path`` first.

    Raises:
        EnvError: if there is no such function.
    """
    if is_given(text):
        return _given(text, key)
    module_name, colon, name = text.partition(":")
    if not colon or not module_name or not name:
        raise EnvError(f"{key} = {text!r}: expected module:function")
    module = import_module(module_name, config)
    function = _attribute(module, name)
    if not callable(function):
        raise EnvError(f"{key} = {text!r}: {_place(module)} has no function {name!r}")
    return function  # type: ignore[no-any-return]


def _given(text: str, key: str) -> Callable[..., Any]:
    found = given(text)
    if found is None:
        raise EnvError(
            f"{key} = {text!r}: this process has no such object; it was defined in a Python session or a script. Put "
            f"it into a module and name that (module:{text.removeprefix(GIVEN)}), or continue in that session"
        )
    return found


def import_module(name: str, config: EnvironmentConfig) -> ModuleType:
    """Import a module, searching the task's folders first, as Python does for a script.

    Skips the folders if the task names only bundled or installed code, so that a foreign policy's folder cannot shadow
    installed modules.

    Raises:
        EnvError: if it cannot be imported; the message says where it was searched.
    """
    folders = config.folders if code_named(config) else ()
    try:
        return import_task_module(name, folders)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            more = explained(error, folders)
            raise EnvError(f"importing {name!r} for environment {config.id!r}: {described(error)}{more}") from None
        raise EnvError(f"environment {config.id!r}: no module {name!r}{_searched(config)}") from None
    except Exception as error:  # user code may raise anything
        more = explained(error, folders) if isinstance(error, ImportError) else ""
        raise EnvError(f"importing {name!r} for environment {config.id!r}: {described(error)}{more}") from error


def _searched(config: EnvironmentConfig) -> str:
    if not config.folders:
        return "; is it installed?"
    searched = [
        folder if Path(folder).is_dir() else f"{folder}, which is no folder on this machine"
        for folder in config.folders
    ]
    return (
        f" in {', nor in '.join(searched)}, nor among what is installed; on another machine, install it there or "
        f"start the worker with PYTHONPATH set to its folder"
    )


def _attribute(module: ModuleType, dotted: str) -> Any:
    found: Any = module
    for name in dotted.split("."):
        found = getattr(found, name, None)
    return found


def _place(module: ModuleType) -> str:
    return f"{module.__name__} ({getattr(module, '__file__', None) or 'built in'})"


def _callable(config: EnvironmentConfig) -> Callable[..., Any]:
    return import_function(config.id, config, "environment.id")


def _plain(spec: Spec) -> Callable[..., Any]:
    plain = copy.deepcopy(spec)
    plain.order_enforce, plain.disable_env_checker, plain.max_episode_steps = False, True, None
    return lambda **options: gym.make(plain, **options)


def _called(config: EnvironmentConfig, options: dict[str, Any], maker: Callable[..., Any]) -> Any:
    try:
        return maker(**options)
    except (TypeError, ValueError) as error:
        raise EnvError(f"environment {config.id!r} refused its options {options}: {error}{calls(error)}") from None
    except (gym.error.Error, ImportError) as error:
        raise EnvError(f"environment {config.id!r}: {error}{calls(error)}") from None
    except Exception as error:  # user code may raise anything
        raise EnvError(f"making environment {config.id!r} with {options}: {described(error)}") from error
