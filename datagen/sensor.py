"""Sensor: the 8-bit pictures as a camera takes them, after the linear images, which stay as they are.

Before: samples.py, colour.py.  After: runs.py; writer.py stores the pictures.
Symbols: H, W image size; light is linear, 1 = what the sensor just does not clip at gain 1.
Order: gain, clipping, mosaic of the colour filter, inverse white balance, shot and read noise, white balance,
demosaicing, clipping, response, 8 bits. What was clipped before the noise stays clipped after it.
A clip has one camera; each frame has noise of its own. The sharp picture goes through the same camera, without noise
unless asked for, as a target for training should be clean.

Source: the order of RSBlur (Rim et al. 2022), without its conversion to a camera's own colour space.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from datagen.colour import MOSAICS, demosaic, mosaic, srgb_from_linear
from datagen.samples import Sample
from datagen.seeds import open_stream
from datagen.spec import DatasetSpec

RED_GAINS, BLUE_GAINS = (1.9, 2.4), (1.5, 1.9)  # white balance, from which a camera's are drawn: RSBlur's
BORDER_PX = 2  # mirrored light around the image, so that demosaicing has neighbours everywhere


@dataclass(frozen=True)
class Sensor:
    """The camera of a clip, with all that was drawn for it."""

    response: str  # srgb or gamma
    gamma: float
    shoulder: float
    gain: float
    photons: float  # that a raw value of 1 stands for; 0: no shot noise
    read_noise: float  # standard deviation, share of a raw value of 1
    white_balance: tuple[float, float, float]
    mosaic: str  # colours of the first row and of the second; empty: every pixel has all three


def choose_sensor(spec: DatasetSpec, clip: int) -> Sensor:
    """Return the camera of a clip, drawn from the specification's ranges.

    Source: ours; white balance and mosaic as RSBlur draws them.
    """
    rng = open_stream(spec.seed, "sensor", clip)
    exposure_stops, noise_stops = rng.uniform(-1, 1, 2) * (spec.sensor_gain_stops, spec.sensor_noise_stops)
    red, blue = rng.uniform(*RED_GAINS), rng.uniform(*BLUE_GAINS)
    pattern = str(rng.choice(list(MOSAICS)))
    return Sensor(
        response=spec.sensor,
        gamma=spec.sensor_gamma,
        shoulder=spec.sensor_shoulder,
        gain=float(spec.sensor_gain * 2.0**exposure_stops),
        photons=float(spec.sensor_photons / 2.0**noise_stops),
        read_noise=float(spec.sensor_read_noise * 2.0**noise_stops),
        white_balance=(float(red), 1.0, float(blue)),
        mosaic=pattern if spec.sensor_mosaic else "",
    )


def photograph(sample: Sample, spec: DatasetSpec, index: int) -> Sample:
    """Return the sample with its pictures taken by the clip's camera, or as it is if the specification has none.

    Args:
        sample: of the frame.
        spec: asks for the camera.
        index: number of the frame; its noise depends on (seed, index) only.

    Source: ours.
    """
    if spec.sensor == "off":
        return sample
    sensor = choose_sensor(spec, spec.clip_and_frame(index)[0])
    quiet = sensor if spec.sensor_sharp_noise else replace(sensor, photons=0.0, read_noise=0.0)
    rng = open_stream(spec.seed, "noise", index)
    pictures = {}
    for name, image, camera in (("blur", sample.blurred, sensor), ("sharp", sample.sharp, quiet)):
        pictures[name] = picture_bytes(record_light(image[..., :3], camera, rng), camera)
    notes = asdict(sensor) | {"sharp_noise": spec.sensor_sharp_noise}
    return replace(sample, pictures=pictures, meta=sample.meta | {"sensor": notes})


def record_light(rgb: Tensor, sensor: Sensor, rng: np.random.Generator) -> Tensor:
    """Return (H, W, 3) float64 light as the sensor tells of it, in [0, 1].

    Args:
        rgb: (H, W, 3) linear; brighter than 1 / gain is clipped.
        sensor: the camera.
        rng: of the frame's noise.

    Source: see the module; shot and read noise as in Foi et al. 2008.
    """
    light = (rgb.detach().to(torch.float64) * sensor.gain).clamp(0, 1)
    height, width = light.shape[:2]
    balance = torch.tensor(sensor.white_balance, dtype=torch.float64).expand(light.shape)
    is_noisy = sensor.photons > 0 or sensor.read_noise > 0
    if not sensor.mosaic:
        return _with_noise(light, balance, sensor, rng) if is_noisy else light
    padded = _mirrored(light)
    raw, raw_balance = mosaic(padded, sensor.mosaic), mosaic(_mirrored(balance), sensor.mosaic)
    if is_noisy:
        raw = _with_noise(raw, raw_balance, sensor, rng)
    inside = demosaic(raw, sensor.mosaic)[BORDER_PX:, BORDER_PX:][:height, :width].clamp(0, 1)
    return torch.where(light >= 1, light, inside)


def picture_bytes(light: Tensor, sensor: Sensor) -> Tensor:
    """Return the (H, W, 3) uint8 picture of (H, W, 3) light in [0, 1].

    `gamma` is light to the power 1 / (gamma + shoulder · light), which rises for every gamma > 0 with gamma + shoulder
    > 0; without a shoulder it is a power curve.

    Source: IEC 61966-2-1; the generalised gamma curve of Ng, Chang and Lin 2007, first order.
    """
    if sensor.response == "srgb":
        coded = srgb_from_linear(light)
    else:
        coded = light ** (1 / (sensor.gamma + sensor.shoulder * light))
    return (coded * 255).round().to(torch.uint8)


def _with_noise(light: Tensor, balance: Tensor, sensor: Sensor, rng: np.random.Generator) -> Tensor:
    """Return light with noise, in [0, 1]; what is clipped stays so."""
    raw = (light / balance).numpy()
    noisy = rng.poisson(raw * sensor.photons) / sensor.photons if sensor.photons > 0 else raw
    noisy = noisy + rng.normal(0.0, sensor.read_noise, raw.shape) if sensor.read_noise > 0 else noisy
    told = (torch.from_numpy(np.asarray(noisy, dtype=np.float64)) * balance).clamp(0, 1)
    return torch.where(light >= 1, light, told)


def _mirrored(image: Tensor) -> Tensor:
    """Return an (H, W, 3) image with a mirrored border and even sizes, as a mosaic needs."""
    height, width = image.shape[:2]
    border = ((BORDER_PX, BORDER_PX + height % 2), (BORDER_PX, BORDER_PX + width % 2), (0, 0))
    return torch.from_numpy(np.pad(image.numpy(), border, mode="reflect"))
