"""Devices to run a test on; those that a machine lacks are skipped, and the summary says so."""

from __future__ import annotations

import pytest
import torch

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no CUDA device here")
needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, needs_gpu])
EVERYWHERE = ("cpu", GPU)
