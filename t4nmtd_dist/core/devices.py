"""Devices for a learner's networks: CPU or GPU."""

from __future__ import annotations

from typing import Literal

from t4nmtd_dist.core.errors import ConfigError

Device = Literal["cpu", "cuda"]


def check_device(device: Device) -> None:
    """Check that PyTorch can use a device; imports PyTorch only for ``cuda``.

    Raises:
        ConfigError: if it cannot; the message says what to do.
    """
    if device == "cpu":
        return
    import torch

    if torch.cuda.is_available():
        return
    if torch.version.cuda is None:
        reason = f"PyTorch {torch.__version__} is a build without CUDA: install one with it (https://pytorch.org)"
    else:
        reason = (
            "PyTorch sees no CUDA device: `nvidia-smi` should list one here; a container needs the NVIDIA container "
            "toolkit and a device reservation"
        )
    raise ConfigError(f"--device {device}: {reason}, or leave --device out")
