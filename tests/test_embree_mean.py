"""Tests of the mean that a ray tracer makes, an opponent in the benchmark: it is that of `accumulate`, or none."""

import benchmark_scenes
import pytest

import torchblur as tb

pytest.importorskip("embreex", reason="NOT TESTED: embreex of the extra `dev` is not installed")

from embree_mean import can_trace, embree_mean


def test_it_is_the_mean_that_accumulate_makes():
    scene = benchmark_scenes.cloth(96, 64)
    assert can_trace(scene)
    gap = (embree_mean(scene, 4) - tb.accumulate(scene, 4).rgba).abs().amax(-1)
    assert (gap > 1e-6).double().mean() < 1e-3, "only rays that graze an edge may differ"


@pytest.mark.parametrize("make", [benchmark_scenes.shards, benchmark_scenes.textured_character])
def test_it_is_not_made_of_glass_nor_of_textures(make):
    assert not can_trace(make(16, 16))
