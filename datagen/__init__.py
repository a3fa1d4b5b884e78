"""datagen: specifications and people's meshes turned into training data with exact motion blur.

Files, each importing only from those before it: seeds, spec, colour, motions, knots, clips, formats, assets,
sequences, keyframes, rigs, gltf, gltf_looks, gltf_takes, gltf_rigs, usd_files, animated, rosters, shapes, patterns,
stages, casts, scenes, baselines/, samples, sensor, pictures, writer, folders, listed_files, manifest, shards,
entries, executors, ray_executor, progress, dataset, report, runs, checks, flow_files, layouts, picture_store, export,
pages, commands, __main__.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datagen.checks import Status, read_status, verify_dataset
    from datagen.dataset import BlurDataset
    from datagen.export import ExportError, ExportResult, export_dataset
    from datagen.flow_files import FlowFileError, encode_flow, read_flow
    from datagen.folders import Slice
    from datagen.formats import MeshError
    from datagen.manifest import ManifestError
    from datagen.runs import RunResult, generate
    from datagen.spec import DatasetSpec, SpecError, parse_spec
    from datagen.writer import FrameFileError

# Found when asked for, so that `--help` and the like need not wait for torch.
_HOMES = {
    "BlurDataset": "dataset",
    "DatasetSpec": "spec",
    "ExportError": "export",
    "ExportResult": "export",
    "FlowFileError": "flow_files",
    "FrameFileError": "writer",
    "ManifestError": "manifest",
    "MeshError": "formats",
    "RunResult": "runs",
    "Slice": "folders",
    "SpecError": "spec",
    "Status": "checks",
    "encode_flow": "flow_files",
    "export_dataset": "export",
    "generate": "runs",
    "parse_spec": "spec",
    "read_flow": "flow_files",
    "read_status": "checks",
    "verify_dataset": "checks",
}
__all__ = [
    "BlurDataset",
    "DatasetSpec",
    "ExportError",
    "ExportResult",
    "FlowFileError",
    "FrameFileError",
    "ManifestError",
    "MeshError",
    "RunResult",
    "Slice",
    "SpecError",
    "Status",
    "encode_flow",
    "export_dataset",
    "generate",
    "parse_spec",
    "read_flow",
    "read_status",
    "verify_dataset",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its file on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'datagen' has no attribute {name!r}")
    return getattr(importlib.import_module(f"datagen.{_HOMES[name]}"), name)
