"""Specification of a data set: what is asked for, checked in full before any work starts.

Before: nothing (a TOML file or the command line).  After: everything else in datagen reads it.
Symbols: count N frames; frame i is frame i % frames_per_clip of clip i // frames_per_clip.
How many workers make the data is no part of it: that must not change a byte.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SEQUENCE_SUFFIXES = (".npz", ".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".usd", ".usda", ".usdc")
BASELINES = ("directional", "mcguire2012", "guertin2014", "guertin2015")  # in baselines/filters.py, which needs torch
# A longer run extends a shorter one; a folder's place is not its content; storage does not change a frame's files.
NOT_IN_THE_BYTES = ("count", "assets", "textures", "backgrounds", "storage", "frames_per_shard")
# Fields that came later, with what data sets were before: with that value they stay the same.
ADDED_LATER = {"lighting": "painted", "backend": "torch"}


class SpecError(ValueError):
    """A specification that cannot be used; `problems` has one line ``name: expected …, got …`` for each wrong field."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class DatasetSpec(BaseModel):
    """What to generate. Immutable; unknown fields are refused.

    Attributes:
        width, height: image size [px].
        count: number of frames in all.
        seed: frame i depends on (seed, i) and on nothing that other frames do.
        source: `primitives` (built-in shapes), `meshes` (people's files) or `sequence` (one mesh played through time).
        assets: the folder of `meshes`; the file or the folder of frames of `sequence`; absent for `primitives`.
        frames_per_clip: consecutive frames that share scene, motion and camera path.
        fps: frames per second of a clip [Hz]; the sharp instants are 1/fps apart.
        exposure: share of the frame time 1/fps during which the shutter is open, in (0, 1].
        rays_per_pixel: rays inside each pixel, 1 = its centre.
        sequence_fps: at what rate the frames of a sequence are played [Hz]; an animated file has its own times.
        lighting: `painted` (a fixed light is painted into colours), `lamps` (moving lamps light the clips, which have
            a floor or walls for their shadows) or `mixed`: one or the other, clip by clip.
        backend: what renders the blurred images: `auto` (compiled where that can be, else torch) or `torch`; see
            `torchblur.render`. They may differ in the last bits.
        textures: a folder of pictures that floors, walls and half of the bodies wear.
        backgrounds: a folder of pictures of which one is behind each clip, instead of walls and skies.
        baselines: filters whose images are stored beside the exact one: names from BASELINES, between commas.
        storage: `folder` (a file for each thing), `shards` (tar files of many frames, as WebDataset has them) or
            `auto`: a folder below 1,000 frames.
        sensor: `off`, or the response of a camera that takes the 8-bit pictures: `srgb` or `gamma`. The linear images
            stay as they are. The other `sensor_…` fields need one.
        sensor_gamma, sensor_shoulder: curve of `gamma`: light to the power 1 / (gamma + shoulder · light).
        sensor_gain, sensor_gain_stops: gain before clipping, and by how many stops it may differ from clip to clip.
        sensor_photons: photons that fill a pixel, for shot noise; 0 for none.
        sensor_read_noise: standard deviation, as a share of a full pixel.
        sensor_noise_stops: by how many stops of sensitivity the noise may differ from clip to clip.
        sensor_mosaic: each pixel sees one colour, the others are interpolated.
        sensor_sharp_noise: noise in the sharp pictures too.
        frames_per_shard: frames of a tar file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    width: int = Field(default=256, ge=1, le=16384)
    height: int = Field(default=256, ge=1, le=16384)
    count: int = Field(default=16, ge=1, le=10**9)
    seed: int = Field(default=0, ge=0, lt=2**63)
    source: Literal["primitives", "meshes", "sequence"] = "primitives"
    assets: str | None = None
    frames_per_clip: int = Field(default=1, ge=1, le=10**6)
    fps: float = Field(default=24.0, gt=0, le=1e6, allow_inf_nan=False)
    exposure: float = Field(default=0.5, gt=0, le=1, allow_inf_nan=False)
    rays_per_pixel: int = Field(default=4, ge=1, le=4096)
    sequence_fps: float = Field(default=24.0, gt=0, le=1e6, allow_inf_nan=False)
    lighting: Literal["painted", "lamps", "mixed"] = "painted"
    backend: Literal["auto", "torch"] = "auto"
    textures: str | None = None
    backgrounds: str | None = None
    storage: Literal["auto", "folder", "shards"] = "auto"
    frames_per_shard: int = Field(default=100, ge=1, le=10**5)
    sensor: Literal["off", "srgb", "gamma"] = "off"
    sensor_gamma: float = Field(default=2.2, gt=0, le=10, allow_inf_nan=False)
    sensor_shoulder: float = Field(default=0.0, ge=-10, le=10, allow_inf_nan=False)
    sensor_gain: float = Field(default=1.0, gt=0, le=1e6, allow_inf_nan=False)
    sensor_gain_stops: float = Field(default=0.0, ge=0, le=16, allow_inf_nan=False)
    sensor_photons: float = Field(default=0.0, ge=0, le=1e9, allow_inf_nan=False)
    sensor_read_noise: float = Field(default=0.0, ge=0, le=1, allow_inf_nan=False)
    sensor_noise_stops: float = Field(default=0.0, ge=0, le=16, allow_inf_nan=False)
    sensor_mosaic: bool = False
    sensor_sharp_noise: bool = False

    baselines: str = ""

    @field_validator("textures", "backgrounds")
    @classmethod
    def _picture_folders_exist(cls, text: str | None, info: ValidationInfo) -> str | None:
        if text is not None and not _is_recorded(info) and not Path(text).is_dir():
            raise ValueError(f"{info.field_name}: expected a folder of pictures, got {text!r}, which is no folder")
        return text

    @field_validator("baselines")
    @classmethod
    def _baselines_exist(cls, text: str) -> str:
        names = text.split(",") if text else []
        if len(set(names)) < len(names) or not set(names) <= set(BASELINES):
            raise ValueError(
                f"baselines: expected different ones of {', '.join(BASELINES)}, between commas, got {text!r}"
            )
        return text

    @model_validator(mode="after")
    def _assets_fit_the_source(self, info: ValidationInfo) -> DatasetSpec:
        problem = "" if _is_recorded(info) else assets_problem(self.source, self.assets)
        if problem:
            raise ValueError(problem)
        return self

    @model_validator(mode="after")
    def _sensor_fits(self) -> DatasetSpec:
        names = [n for n in type(self).model_fields if n.startswith("sensor_")]
        if self.sensor != "gamma":
            unread = names if self.sensor == "off" else ["sensor_gamma", "sensor_shoulder"]
            changed = [n for n in unread if getattr(self, n) != type(self).model_fields[n].default]
            if changed:
                wanted = "gamma" if self.sensor == "srgb" else "srgb or gamma"
                raise ValueError(f"sensor: expected {wanted} for {', '.join(changed)}, got {self.sensor!r}")
        elif self.sensor_gamma + self.sensor_shoulder <= 0:
            total = self.sensor_gamma + self.sensor_shoulder
            raise ValueError(f"sensor_shoulder: expected sensor_gamma + sensor_shoulder above 0, got {total:g}")
        return self

    @property
    def exposure_s(self) -> float:
        """How long the shutter is open [s]."""
        return self.exposure / self.fps

    @property
    def baseline_names(self) -> tuple[str, ...]:
        """The filters whose images are stored, in the order of BASELINES."""
        return tuple(name for name in BASELINES if name in self.baselines.split(","))

    def clip_and_frame(self, index: int) -> tuple[int, int]:
        """Return (clip, frame within the clip) of frame `index` of the data set."""
        return index // self.frames_per_clip, index % self.frames_per_clip

    def to_json(self) -> str:
        """Return the specification as one line of JSON, keys sorted."""
        return json.dumps(self.model_dump(), sort_keys=True)

    def config_sha256(self, assets_sha256: str = "") -> str:
        """Return the hash of everything that the bytes of a frame depend on.

        Args:
            assets_sha256: hash of the contents of the assets that are used; their place on disk does not count.

        Source: ours.
        """
        left_out = {name for name, before in ADDED_LATER.items() if getattr(self, name) == before}
        fields = {k: v for k, v in self.model_dump().items() if k not in left_out.union(NOT_IN_THE_BYTES)}
        text = json.dumps(fields | {"assets_sha256": assets_sha256}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def assets_problem(source: str, assets: str | None) -> str:
    """Return what is wrong with `assets` for `source` as ``assets: expected …, got …``, or an empty string."""
    if source == "primitives":
        return "" if assets is None else f"assets: expected none for source primitives, got {assets!r}"
    wanted = "a folder of mesh files" if source == "meshes" else "a .npz file, a mesh file or a folder of frames"
    if assets is None:
        return f"assets: expected {wanted} for source {source}, got nothing"
    path = Path(assets)
    if source == "meshes":
        return "" if path.is_dir() else f"assets: expected {wanted}, got {assets!r}, which is no folder"
    if path.is_dir() or (path.is_file() and path.suffix.lower() in SEQUENCE_SUFFIXES):
        return ""
    why = "which does not exist" if not path.exists() else f"whose suffix is none of {', '.join(SEQUENCE_SUFFIXES)}"
    return f"assets: expected {wanted}, got {assets!r}, {why}"


def parse_spec(fields: dict[str, Any]) -> DatasetSpec:
    """Return the specification with `fields`; the others have their defaults.

    Raises:
        SpecError: any number of wrong fields, all listed.

    Example:
        >>> parse_spec({"count": 3}).count
        3

    Source: ours.
    """
    try:
        return DatasetSpec.model_validate(fields)
    except ValidationError as error:
        problems = [_problem_text(e) for e in error.errors(include_url=False)]
        source = fields.get("source", "primitives")
        if not any(p.startswith(("assets:", "source:")) for p in problems):  # a field's error keeps pydantic from it
            assets = fields.get("assets")
            late = assets_problem(source, assets) if isinstance(assets, str | None) else ""
            problems += [late] if late else []
        raise SpecError(problems) from None


def recorded_spec(fields: dict[str, Any]) -> DatasetSpec:
    """Return the specification of a data set that is there, whose assets and pictures may be elsewhere by now.

    Raises:
        SpecError: any number of wrong fields, all listed.

    Source: ours.
    """
    try:
        return DatasetSpec.model_validate(fields, context={"is_recorded": True})
    except ValidationError as error:
        raise SpecError([_problem_text(e) for e in error.errors(include_url=False)]) from None


def read_spec_fields(path: str | Path) -> dict[str, Any]:
    """Return the fields in a TOML file, not yet checked.

    Raises:
        SpecError: the file cannot be read or is not TOML.

    Source: ours.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # also of numbers with too many digits
        raise SpecError([f"config: expected a readable TOML file, got {str(path)!r}: {error}"]) from None


def _is_recorded(info: ValidationInfo) -> bool:
    """Tell whether a specification is read from a data set that is there."""
    return bool((info.context or {}).get("is_recorded"))


def _problem_text(error: Any) -> str:
    """Return one of pydantic's errors in the project's form."""
    name = ".".join(str(p) for p in error["loc"])
    kind, value, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "value_error":
        return str(context["error"])
    if kind == "extra_forbidden":
        known = ", ".join(DatasetSpec.model_fields)
        return f"{name}: expected one of the fields {known}, got an unknown field"
    expected = error["msg"].removeprefix("Input should be ").removeprefix("Input should ")
    return f"{name}: expected {expected}, got {value!r}"
