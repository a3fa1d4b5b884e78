"""torchblur: motion blur of moving triangle meshes, integrated exactly over the exposure, as PyTorch tensors."""

from torchblur.accuracy import Accuracy
from torchblur.camera import Camera
from torchblur.effects import EFFECTS, Effect, EffectPlan, plan_effects
from torchblur.instant import Instant, motion_to, render_instant
from torchblur.lights import DirectionalLight, PointLight, SpotLight
from torchblur.material import Material
from torchblur.metrics import flip_hdr, flip_ldr, psnr, ssim
from torchblur.ops import render_meshes
from torchblur.render import Frame, render, render_windows
from torchblur.sampling import Accumulated, accumulate, stochastic
from torchblur.scene import Mesh, Scene
from torchblur.shutter import Shutter

__version__ = "0.1.0"
__all__ = [
    "EFFECTS",
    "Accumulated",
    "Accuracy",
    "Camera",
    "DirectionalLight",
    "Effect",
    "EffectPlan",
    "Frame",
    "Instant",
    "Material",
    "Mesh",
    "PointLight",
    "Scene",
    "Shutter",
    "SpotLight",
    "accumulate",
    "flip_hdr",
    "flip_ldr",
    "motion_to",
    "plan_effects",
    "psnr",
    "render",
    "render_instant",
    "render_meshes",
    "render_windows",
    "ssim",
    "stochastic",
]
