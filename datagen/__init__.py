"""datagen: specifications and people's meshes turned into training data with exact motion blur.

Files, each importing only from those before it: seeds, spec, colour, motions, knots, clips, formats, assets,
sequences, shapes, patterns, stages, casts, scenes, baselines/, samples, pictures, writer, manifest, executors,
progress, dataset, report, runs, __main__.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datagen.dataset import BlurDataset
    from datagen.formats import MeshError
    from datagen.manifest import ManifestError, verify_dataset
    from datagen.runs import RunResult, generate
    from datagen.spec import DatasetSpec, SpecError, parse_spec
    from datagen.writer import FrameFileError

# Found when asked for, so that `--help` and the like need not wait for torch.
_HOMES = {
    "BlurDataset": "dataset",
    "DatasetSpec": "spec",
    "FrameFileError": "writer",
    "ManifestError": "manifest",
    "MeshError": "formats",
    "RunResult": "runs",
    "SpecError": "spec",
    "generate": "runs",
    "parse_spec": "spec",
    "verify_dataset": "manifest",
}
__all__ = [
    "BlurDataset",
    "DatasetSpec",
    "FrameFileError",
    "ManifestError",
    "MeshError",
    "RunResult",
    "SpecError",
    "generate",
    "parse_spec",
    "verify_dataset",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its file on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'datagen' has no attribute {name!r}")
    return getattr(importlib.import_module(f"datagen.{_HOMES[name]}"), name)
