"""Images of an independent path tracer, 4,096 to 8,192 samples a pixel, that lie beside the repository.

Rule of the references' README: the RMSE of our linear RGB lies within 1.25 times the larger of the reference's own
noise and the distance between the reference and a float64 brute force of 8,192 sub-frames.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import torchblur as tb

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "references"


def read_scene(folder: Path, dtype: torch.dtype) -> tuple[tb.Scene, np.ndarray]:
    """Return the scene of a folder, a mesh for unlit and one for lit faces, and the reference image (H, W, 3)."""
    exr = pytest.importorskip("OpenEXR")
    with np.load(folder / "scene.npz", allow_pickle=False) as z:
        s = {k: z[k] for k in z.files}
    vertices = torch.as_tensor(np.stack([s["verts0"], s["verts1"]])).to(dtype)
    texture, uv = None, None
    if s["face_textured"].any():
        assert s["face_textured"].all(), "part of the faces textured: needs two meshes"
        texture = np.load(folder / "texture.npy", allow_pickle=False)[::-1]  # stored with row 0 at v = 0
        uv = torch.as_tensor(s["uv"])
    color, opacity = torch.as_tensor(s["face_color"]), torch.as_tensor(s["face_opacity"])
    is_lit = s.get("face_lambert", np.zeros(len(s["faces"]), np.uint8)) > 0
    meshes = []
    for shading, chosen in (("unlit", ~is_lit), ("lambert", is_lit)):
        if chosen.any():
            look = {"texture": texture, "wrap": "clamp", "mipmap": False, "shading": shading}
            material = tb.Material(color[chosen], opacity[chosen], **look)
            own_uv = None if uv is None else uv[chosen]
            meshes.append(tb.Mesh(vertices, torch.as_tensor(s["faces"][chosen]), material, uv=own_uv))
    lights = [tb.PointLight(s["light_position"], float(s["light_intensity"]))] if is_lit.any() else []
    camera = tb.Camera(torch.as_tensor(s["world_to_clip"]), int(s["width"]), int(s["height"]))
    scene = tb.Scene(meshes, camera, torch.as_tensor(s["background"]), lights=lights)
    with exr.File(str(folder / "ref.exr")) as file:
        channels = file.parts[0].channels
        if "RGB" in channels:
            image = channels["RGB"].pixels
        else:
            image = np.stack([channels[c].pixels for c in "RGB"], -1)
        image = np.array(image, dtype=np.float64)
    return scene, image


@pytest.mark.parametrize("name", ["quad", "tris200", "plank", "shadow_floor"])
def test_matches_the_path_tracer_within_its_noise(name, dtype):
    if not (FOLDER / name).is_dir():
        pytest.skip(f"NOT TESTED: reference images are not at {FOLDER}")
    if name == "tris200" and dtype == torch.float64:
        pytest.skip("tris200 takes 20 s; float32, the coarser type, is the one that runs")
    scene, image = read_scene(FOLDER / name, dtype)
    meta = json.loads((FOLDER / name / "meta.json").read_text())
    got = tb.render(scene).rgba[..., :3].double().numpy()
    assert got.shape == image.shape
    rmse = float(np.sqrt(np.mean((got - image) ** 2)))
    assert rmse <= 1.25 * max(meta["est_rmse_ref"], meta["rmse_brute_force_8192"])
    sharp = tb.render_instant(scene, t=0.5).rgba[..., :3].double().numpy()
    assert np.sqrt(np.mean((sharp - image) ** 2)) > 100 * rmse, "a sharp image would pass: the comparison is blind"
