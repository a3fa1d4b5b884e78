"""Small glTF files made by hand: tables, nodes, skins, morphs and animations, embedded, beside the file, or binary."""

import base64
import json
import struct

import numpy as np

CODES = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
SQUARE_FACES = [0, 1, 2, 0, 2, 3]


class Maker:
    """A glTF tree under construction; `tree` may be changed freely before `save`."""

    def __init__(self):
        self.data = b""
        self.tree = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
        self.tree |= {name: [] for name in ("nodes", "meshes", "accessors", "bufferViews")}

    def view(self, data):
        """Add a buffer view and return its number."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def table(self, rows, dtype="<f4", **more):
        """Add an accessor of rows and return its number."""
        rows = np.asarray(rows)
        rows = rows.reshape(len(rows), -1)
        entry = {"bufferView": self.view(rows.astype(dtype).tobytes()), "componentType": CODES[dtype]}
        self.tree["accessors"].append(entry | {"count": len(rows), "type": KINDS[rows.shape[1]]} | more)
        return len(self.tree["accessors"]) - 1

    def mesh(self, vertices=SQUARE, faces=SQUARE_FACES, targets=(), **more):
        """Add a mesh of one primitive and return its number."""
        attributes = {"POSITION": self.table(vertices)} | more.pop("attributes", {})
        primitive = {"attributes": attributes, "indices": self.table(faces, "<u2")} | more
        if targets:
            primitive["targets"] = [{"POSITION": self.table(t)} for t in targets]
        self.tree["meshes"].append({"primitives": [primitive]})
        return len(self.tree["meshes"]) - 1

    def node(self, **fields):
        """Add a node and return its number."""
        self.tree["nodes"].append(fields)
        return len(self.tree["nodes"]) - 1

    def skin(self, joints, binds=None):
        """Add a skin and return its number."""
        skin = {"joints": joints}
        if binds is not None:  # rows of matrices that act on columns; the file has columns
            skin["inverseBindMatrices"] = self.table([np.asarray(b).T.ravel() for b in binds])
        self.tree.setdefault("skins", []).append(skin)
        return len(self.tree["skins"]) - 1

    def animation(self, *channels, name="take"):
        """Add an animation of channels (node, path, times, values, interpolation)."""
        made, samplers = [], []
        for node, path, times, values, kind in channels:
            values = np.asarray(values, dtype=np.float64)
            values = values.reshape(-1, 1) if path == "weights" else values
            samplers.append({"input": self.table(times), "output": self.table(values), "interpolation": kind})
            made.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        self.tree.setdefault("animations", []).append({"name": name, "channels": made, "samplers": samplers})

    def embedded(self):
        """Return the bytes of a .gltf file that holds its buffer."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        return json.dumps(self.tree | {"buffers": [{"byteLength": len(self.data), "uri": uri}]}).encode()

    def binary(self):
        """Return the bytes of a .glb file."""
        text = json.dumps(self.tree | {"buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def save(self, path, beside=False):
        """Write the file, with its buffer beside it if asked to, and return its path."""
        if beside:
            path.with_suffix(".bin").write_bytes(self.data)
            buffer = {"byteLength": len(self.data), "uri": path.with_suffix(".bin").name}
            path.write_text(json.dumps(self.tree | {"buffers": [buffer]}))
        else:
            path.write_bytes(self.binary() if path.suffix == ".glb" else self.embedded())
        return str(path)


def turn(axis, degrees):
    """Return the quaternion (x, y, z, w) of a turn."""
    half = np.radians(degrees) / 2
    return [*(np.asarray(axis, dtype=float) * np.sin(half)), np.cos(half)]


def spinner(kind="LINEAR", degrees=120.0):
    """Return a square that turns about z in one second."""
    maker = Maker()
    node = maker.node(mesh=maker.mesh(), translation=[2, 0, 0])
    keys = [turn((0, 0, 1), 0), turn((0, 0, 1), degrees)]
    maker.animation((node, "rotation", [0, 1], keys, kind))
    return maker


def bender():
    """Return a strip along x of two bones, at x 0 and 1; the second turns by 90 degrees in one second."""
    maker = Maker()
    x = np.repeat([0.0, 0.5, 1.0, 1.5, 2.0], 2)
    vertices = np.stack([x, np.tile([-0.1, 0.1], 5), np.zeros(10)], 1)
    faces = [k for i in range(4) for k in (2 * i, 2 * i + 2, 2 * i + 1, 2 * i + 1, 2 * i + 2, 2 * i + 3)]
    share = np.clip(x - 0.5, 0, 1)  # 0, 0, 0.5, 1, 1 along the strip
    weights = np.stack([1 - share, share, 0 * share, 0 * share], 1)
    joints = np.tile([0, 1, 0, 0], (10, 1))
    attributes = {"JOINTS_0": maker.table(joints, "<u1"), "WEIGHTS_0": maker.table(weights)}
    mesh = maker.mesh(vertices, faces, attributes=attributes)
    back = np.eye(4)
    back[0, 3] = -1
    maker.node(mesh=mesh, skin=maker.skin([1, 2], [np.eye(4), back]), translation=[50, 0, 0])  # which moves nothing
    maker.node(children=[2])
    maker.node(translation=[1, 0, 0])
    maker.tree["scenes"] = [{"nodes": [0, 1]}]
    maker.animation((2, "rotation", [0, 1], [turn((0, 0, 1), 0), turn((0, 0, 1), 90)], "LINEAR"))
    return maker


def morpher():
    """Return a square with two morph targets whose weights go from 0, 0 over 1, 0 to 0.5, 1 at 0, 1 and 2 s."""
    maker = Maker()
    up, aside = np.tile([0, 0, 1], (4, 1)), np.array([(0, 0, 0), (2, 0, 0), (0, 0, 0), (0, 0, 0)])
    node = maker.node(mesh=maker.mesh(targets=[up, aside]))
    maker.animation((node, "weights", [0, 1, 2], [0, 0, 1, 0, 0.5, 1], "LINEAR"))
    return maker
