"""Command line: `python -m datagen [generate] --out DIR …` and the commands of commands.py (the only door to tyro).

Before: spec.py, commands.py.  After: nothing.
Starting the same command again finishes what is missing. The exit codes are in commands.py.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import tyro

from datagen.commands import COMMANDS, EXIT_DONE, EXIT_INTERRUPTED, EXIT_USAGE, make_dataset, run_command, tell_usage
from datagen.spec import SpecError, parse_spec, read_spec_fields

PROGRAM = "python -m datagen"
NOT_IN_THE_SPEC = ("out", "workers", "slice", "config", "executor")


@dataclass(frozen=True)
class Arguments:
    """Generate sharp and exactly motion-blurred images with motion, depth, masks and ids.

    Stopped or killed, the same command finishes the rest; the bytes depend neither on that nor on the workers.
    Other commands: init, status, verify, retry, export, inspect, report; each has its own --help.
    """

    out: str
    """Folder of the data set; created if need be."""
    config: str | None = None
    """TOML file with any of the options below but --workers, --executor and --slice; options given here win."""
    count: int = 16
    """Number of frames."""
    width: int = 256
    """Width of the images [px]."""
    height: int = 256
    """Height of the images [px]."""
    seed: int = 0
    """Everything random follows from it."""
    source: Literal["primitives", "meshes", "sequence"] = "primitives"
    """Built-in shapes, a folder of mesh files, or one mesh played through time."""
    assets: str | None = None
    """Folder of mesh files (meshes); .npz, mesh file or folder of frames (sequence)."""
    frames_per_clip: int = 1
    """Consecutive frames that share scene, motion and camera path."""
    fps: float = 24.0
    """Frames per second of a clip."""
    exposure: float = 0.5
    """Share of the frame time during which the shutter is open, above 0 to 1."""
    rays_per_pixel: int = 4
    """Rays inside each pixel, each exact in time; 1 is the pixel's centre."""
    sequence_fps: float = 24.0
    """Frames per second at which a sequence of frames is played; an animated file has its own times."""
    lighting: Literal["painted", "lamps", "mixed"] = "painted"
    """Light painted into the colours; lamps that move and cast shadows, which take longer; or either, clip by clip."""
    backend: Literal["auto", "torch"] = "auto"
    """What renders the blurred images: auto, compiled where that can be, or torch, as all were before this option."""
    textures: str | None = None
    """Folder of pictures (PNG, JPEG, WebP, BMP) that floors, walls and half of the bodies wear."""
    backgrounds: str | None = None
    """Folder of pictures of which one is behind each clip, instead of walls and skies."""
    baselines: str = ""
    """Filters whose images are stored beside the exact one: some of directional, mcguire2012, guertin2014, guertin2015,
    between commas."""
    storage: Literal["auto", "folder", "shards"] = "auto"
    """A file for each thing, or tar files as WebDataset has them; auto: tar files from 1,000 frames on."""
    frames_per_shard: int = 100
    """Frames of a tar file."""
    sensor: Literal["off", "srgb", "gamma"] = "off"
    """Take the 8-bit pictures with a camera of this response; the linear images stay as they are."""
    sensor_gamma: float = 2.2
    """Of the response gamma: light to the power 1 / (gamma + shoulder * light)."""
    sensor_shoulder: float = 0.0
    """See there."""
    sensor_gain: float = 1.0
    """Gain before what is too bright is clipped."""
    sensor_gain_stops: float = 0.0
    """By how many stops the gain may differ from clip to clip."""
    sensor_photons: float = 0.0
    """Photons that fill a pixel, for shot noise; 0 for none."""
    sensor_read_noise: float = 0.0
    """Standard deviation of read noise, as a share of a full pixel."""
    sensor_noise_stops: float = 0.0
    """By how many stops of sensitivity the noise may differ from clip to clip."""
    sensor_mosaic: bool = False
    """Each pixel sees one colour of a Bayer filter, the others are interpolated."""
    sensor_sharp_noise: bool = False
    """Noise in the sharp pictures too."""
    workers: int = 1
    """Processes that make frames; 0 and 1 work in this one."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or Ray's workers: of this machine, or of the cluster that RAY_ADDRESS names."""
    slice: str | None = None
    """Make part i of n, as `3/100`; the other parts may run elsewhere at the same time. Needs --storage shards."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Args:
        argv: arguments without the program's name; those of the process if not given.

    Source: ours.
    """
    try:
        code = _run_words(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # who reads has read enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_DONE
    except KeyboardInterrupt:
        print("interrupted; the same command finishes the rest", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run_words(words: list[str]) -> int:
    """Run the command that the words ask for and return the exit code."""
    name = words[0] if words and not words[0].startswith("-") else "generate"
    if name in COMMANDS:
        try:
            configured = tyro.conf.configure(tyro.conf.PositionalRequiredArgs, tyro.conf.FlagConversionOff)
            command = tyro.cli(configured(COMMANDS[name]), prog=f"{PROGRAM} {name}", args=words[1:])
        except SystemExit as stop:  # tyro has printed the help or what is wrong
            return EXIT_DONE if stop.code in (0, None) else EXIT_USAGE
        return run_command(command)
    if name != "generate":
        return tell_usage([f"command: expected one of generate, {', '.join(COMMANDS)}, got {name!r}"])
    words = words[words[:1] == ["generate"] :]
    try:
        arguments = tyro.cli(tyro.conf.configure(tyro.conf.FlagConversionOff)(Arguments), prog=PROGRAM, args=words)
        given = {} if arguments.config is None else read_spec_fields(arguments.config)
        spec = parse_spec(given | _fields_given(words, arguments))
    except SpecError as error:
        return tell_usage(error.problems)
    except SystemExit as stop:
        return EXIT_DONE if stop.code in (0, None) else EXIT_USAGE
    return make_dataset(spec, arguments.out, arguments.workers, arguments.slice, arguments.executor)


def _fields_given(words: Sequence[str], arguments: Arguments) -> dict[str, Any]:
    """Return the fields of the specification that the command line names itself, which win over those of a file."""
    named = {word.partition("=")[0].removeprefix("--").replace("-", "_") for word in words if word.startswith("--")}
    wanted = [f.name for f in fields(Arguments) if f.name in named and f.name not in NOT_IN_THE_SPEC]
    return {name: getattr(arguments, name) for name in wanted}


if __name__ == "__main__":
    sys.exit(main())
