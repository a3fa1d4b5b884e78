"""Fixtures: device, dtype, a seeded generator. Everything runs on the CPU; on CUDA too where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None, max_examples=25)
settings.register_profile("slow", derandomize=True, deadline=None, max_examples=5000)  # --hypothesis-profile=slow
settings.load_profile("fixed")
torch.set_num_threads(1)  # the tensors of tests are tiny: threads would only wait for each other


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Return each device in turn; CUDA is skipped with a reason where there is none."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device on this machine")
    return torch.device(request.param)


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Return each floating type in turn."""
    return request.param


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that gives the same numbers to every test."""
    return np.random.default_rng(20240607)


@pytest.fixture
def generator() -> torch.Generator:
    """Return a torch generator that gives the same numbers to every test."""
    return torch.Generator().manual_seed(20240607)
