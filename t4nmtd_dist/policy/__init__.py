"""The global policy: loading, acting, evaluation, export and recording."""

from t4nmtd_dist.policy.global_policy import GlobalPolicy, load

__all__ = ["GlobalPolicy", "load"]
