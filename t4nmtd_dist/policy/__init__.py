"""The global policy: loading, acting, evaluation, export and recording.

Imports ``load`` and ``GlobalPolicy`` lazily, so that ``policy.export`` works without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from t4nmtd_dist.policy.global_policy import GlobalPolicy
    from t4nmtd_dist.policy.loading import load

__all__ = ["GlobalPolicy", "load"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from t4nmtd_dist.policy import loading

    return getattr(loading, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
