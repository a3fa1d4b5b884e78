"""Mutated files of every format that datagen reads: none may crash the reader, hang it, take 2 GB, or pass unsound.

    python scripts/fuzz_assets.py --count 2000

Each file is read in a forked process whose end, memory and time are looked at. USD's library is not ours: datagen
reads a USD file in a process of its own first, within bounds, as is done here; its deaths and its slow files are
refusals there.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import re
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

from gltf_makers import SQUARE, SQUARE_FACES, bender, morpher, spinner  # noqa: E402  after the path

from datagen.formats import MeshError  # noqa: E402
from datagen.usd_files import VET_BYTES, try_usd  # noqa: E402

MAX_BYTES = 2 * 2**30
MAX_SECONDS = 60
USABLE, REFUSED, UNSOUND, OTHER = 0, 10, 11, 12
USD_ENDS = {"died", "slow", "other error"}
NUMBERS = (b"0", b"-1", b"1", b"255", b"65536", b"4294967295", b"99999999999999", b"1e308", b"1e999", b"nan", b"-inf")
VALUES = (None, True, 0, -1, 1, 3, 255, 2**31, 10**15, 1e300, float("nan"), "", "x", [], {}, [0], [[]], "VEC3")
CORNERS, TRIANGLES = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]
USD_TEXT = """#usda 1.0
(
    timeCodesPerSecond = 24
    upAxis = "Z"
)
def Xform "x" {
    double3 xformOp:translate = (2, 0, 0)
    float xformOp:rotateZ.timeSamples = { 0: 0, 24: 120 }
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    def Mesh "m" {
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2]
        point3f[] points.timeSamples = {
            0: [(0,0,0), (1,0,0), (1,1,0), (0,1,0)], 9: [(0,0,0), (2,0,0), (2,2,1), (0,2,0)]
        }
        color3f[] primvars:displayColor = [(0, 0.5, 0), (1, 0, 0)] ( interpolation = "uniform" )
        float[] primvars:displayOpacity = [0.5] ( interpolation = "constant" )
    }
}
"""


def seeds() -> dict[str, dict[str, bytes]]:
    """Return sound files by format: the main file first, then what lies beside it."""
    points = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    obj = re.sub("^", "v ", points, flags=re.M).removesuffix("v ")
    obj += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in TRIANGLES)
    off = "OFF\n4 4 0\n" + points + "".join(f"3 {a} {b} {c}\n" for a, b, c in TRIANGLES)
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n" + "".join(f"property float {c}\n" for c in "xyz")
    ply += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    binary_ply = ply.encode() + np.array(SQUARE, "<f4").tobytes()
    binary_ply += b"".join(b"\x03" + np.array(f, "<i4").tobytes() for f in np.reshape(SQUARE_FACES, (2, 3)))
    corners = np.array(CORNERS, "<f4")[np.array(TRIANGLES)]
    stl = bytes(80) + np.array(4, "<u4").tobytes()
    stl += b"".join(np.zeros(3, "<f4").tobytes() + corner.tobytes() + b"\0\0" for corner in corners)
    archive = io.BytesIO()
    moving = np.stack([np.array(CORNERS, float) * k for k in (1.0, 1.5, 2.0)])
    np.savez(archive, vertices=moving, faces=np.array(TRIANGLES, np.int32))
    beside = spinner()
    buffer = {"byteLength": len(beside.data), "uri": "a.bin"}
    others = {
        "gltf": {"a.gltf": bender().embedded()},
        "gltf and bin": {"a.gltf": json.dumps(beside.tree | {"buffers": [buffer]}).encode(), "a.bin": beside.data},
        "glb": {"a.glb": morpher().binary()},
        "npz": {"a.npz": archive.getvalue()},
        "obj": {"a.obj": obj.encode()},
        "off": {"a.off": off.encode()},
        "ply": {"a.ply": binary_ply},
        "stl": {"a.stl": stl},
    }
    try:
        from pxr import Sdf
    except ModuleNotFoundError:
        print("usda, usdc: left out, usd-core is not installed")
        return others
    with tempfile.TemporaryDirectory() as name:
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(USD_TEXT)
        layer.Export(f"{name}/a.usdc")
        crate = Path(f"{name}/a.usdc").read_bytes()
    # First, as they need a process that has not taken much address space yet.
    return {"usda": {"a.usda": USD_TEXT.encode()}, "usdc": {"a.usdc": crate}} | others


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a file changed in one to four ways; glTF more often in its tree than in its bytes."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        way = 5 if data[:1] in (b"{", b"g") and rng.random() < 0.7 else rng.randrange(6)
        if way <= 1:  # a byte, or four as a number
            size = 1 if way == 0 else 4
            new = rng.randbytes(size) if rng.random() < 0.5 else rng.choice((b"\xff", b"\0", b"\x7f")) * size
            data = data[:at] + new + data[at + size :]
        elif way == 2:  # cut
            data = data[:at] if rng.random() < 0.3 else data[:at] + data[at + rng.randint(1, 40) :]
        elif way == 3:  # twice
            data = data[:at] + data[at : at + rng.randint(1, 60)] + data[at:]
        elif way == 4:  # a number of a text
            found = list(re.finditer(rb"-?\d+\.?\d*", data[:100_000]))
            if found:
                hit = rng.choice(found)
                data = data[: hit.start()] + rng.choice(NUMBERS) + data[hit.end() :]
        else:
            data = _mutate_json(data, rng)
    return data


def _mutate_json(data: bytes, rng: random.Random) -> bytes:
    """Return a glTF or GLB file with one value of its tree changed, and any other file as it is."""
    is_binary = data[:4] == b"glTF"
    end = 20 + int.from_bytes(data[12:16], "little") if is_binary else len(data)
    try:
        tree = json.loads(data[20 if is_binary else 0 : end])
    except (ValueError, RecursionError):
        return data
    places = list(_places(tree))
    if not places:
        return data
    (holder, key), (other_holder, other_key) = rng.choice(places), rng.choice(places)
    holder[key] = json.loads(json.dumps(other_holder[other_key])) if rng.random() < 0.3 else rng.choice(VALUES)
    text = json.dumps(tree).encode()
    if not is_binary:
        return text
    text += b" " * (-len(text) % 4)
    rest = data[end:]
    lengths = (20 + len(text) + len(rest)).to_bytes(4, "little") + len(text).to_bytes(4, "little")
    return data[:8] + lengths + b"JSON" + text + rest


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every (container, key) of a JSON value."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(items):
        yield tree, key
        yield from _places(value)


def read(path: str) -> int:
    """Read a file as datagen does and return what became of it."""
    try:
        if path.endswith((".usda", ".usdc")):
            import resource  # as in the process in which datagen tries such a file

            resource.setrlimit(resource.RLIMIT_AS, (VET_BYTES, VET_BYTES))
            try_usd(Path(path))
            return USABLE
        return _read(path)
    except MeshError:
        return REFUSED
    except Exception as error:
        print(f"{path}: {type(error).__name__}: {error}", file=sys.stderr)
        return OTHER


def _read(path: str) -> int:
    """Return what becomes of a file of another format than USD."""
    import torch

    from datagen.animated import is_animated, load_animated
    from datagen.assets import MAX_COORDINATE, load_mesh
    from datagen.sequences import load_sequence

    if path.endswith(".npz"):
        asset = load_sequence(path)
        positions = asset.positions
    elif is_animated(path):
        asset = load_animated(path)
        poses = [action.pose for action in asset.actions]
        positions = torch.cat([p.at(torch.linspace(float(p.keys_s[0]), float(p.keys_s[-1]), 7)) for p in poses])
    else:
        asset = load_mesh(path)
        positions = asset.vertices[None]
    faces, count = asset.faces, positions.shape[1]
    is_sound = bool(torch.isfinite(positions).all()) and float(positions.abs().max()) <= MAX_COORDINATE
    return USABLE if is_sound and len(faces) and int(faces.min()) >= 0 and int(faces.max()) < count else UNSOUND


def try_file(path: str) -> tuple[str, int]:
    """Read a file in a forked process; return what became of it and the most memory it took [bytes]."""
    pid = os.fork()
    if pid == 0:
        signal.alarm(MAX_SECONDS)
        if path.endswith((".usda", ".usdc")):  # the library tells every fault it finds
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        code = OTHER
        try:
            code = read(path)
        finally:
            os._exit(code)
    _, status, usage = os.wait4(pid, 0)
    code = os.waitstatus_to_exitcode(status)
    memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    if code < 0:
        return "slow" if -code == signal.SIGALRM else "died", memory
    named = {USABLE: "usable", REFUSED: "refused", UNSOUND: "unsound"}
    return "large" if memory > MAX_BYTES else named.get(code, "other error"), memory


def fuzz(name: str, files: dict[str, bytes], count: int, seed: int) -> tuple[Counter[str], int]:
    """Try `count` mutations of a format's files; return how often what happened, and the most memory [bytes]."""
    rng, tally, peak = random.Random(f"{name} {seed}"), Counter(), 0
    main_file, *_ = files
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            chosen = rng.choice(list(files))
            place = Path(folder) / str(k)
            place.mkdir()
            for other, data in files.items():
                (place / other).write_bytes(mutate(data, rng) if other == chosen else data)
            ended, memory = try_file(str(place / main_file))
            tally[ended] += 1
            peak = max(peak, memory)
            if not is_kept(name, Counter([ended])):
                print(f"{name}: number {k} of seed {seed} ended {ended}, {memory / 2**20:.0f} MB", flush=True)
            for file in place.iterdir():
                file.unlink()
    return tally, peak


def is_kept(name: str, tally: Counter[str]) -> bool:
    """Tell whether the promise was kept: all refused or sound; USD's reader may die, in a process of its own."""
    return set(tally) <= {"usable", "refused"} | (USD_ENDS if name.startswith("usd") else set())


def main() -> int:
    """Run what is asked for and return 0 if every promise was kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="mutated files of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--formats", default="", help="some of them, between commas")
    chosen = parser.parse_args()
    broken = 0
    for name, files in seeds().items():
        if chosen.formats and name not in chosen.formats.split(","):
            continue
        if not name.startswith("usd"):
            import datagen.rosters  # noqa: F401  once, not in every process that is forked
        tally, peak = fuzz(name, files, chosen.count, chosen.seed)
        broken += not is_kept(name, tally)
        told = ", ".join(f"{n} {ended}" for ended, n in sorted(tally.items()))
        print(f"{name}: {chosen.count} files: {told}; at most {peak / 2**20:.0f} MB", flush=True)
    return min(broken, 1)


if __name__ == "__main__":
    sys.exit(main())
