"""Matrix products by the faster library for this processor.

torch uses MKL, numpy OpenBLAS. On AMD's Zen 4, OpenBLAS is 5 to 10 % faster on SAC's small products, four fifths of an
update. The choice depends on the CPU vendor, not on a measurement, so runs on one machine are bitwise equal. Both obey
``OMP_NUM_THREADS``, which the programs set to 1 before importing either.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor


def made_by_amd(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor is AMD's according to Linux; False if unknown."""
    try:
        return "AuthenticAMD" in cpuinfo.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False


through_numpy = made_by_amd()


def multiply(left: Tensor, right: Tensor, out: Tensor) -> None:
    """Write the product of (stacks of) matrices [n, i, j] and [n, j, k] to ``out``."""
    if through_numpy:
        np.matmul(left.numpy(), right.numpy(), out=out.numpy())
    else:
        torch.matmul(left, right, out=out)


def multiply_add(bias: Tensor, left: Tensor, right: Tensor, out: Tensor) -> None:
    """Write ``bias + left @ right`` to ``out`` [n, i, k], with ``bias`` broadcast."""
    if through_numpy:
        np.matmul(left.numpy(), right.numpy(), out=out.numpy())
        out.add_(bias)
    else:
        torch.baddbmm(bias, left, right, out=out)
