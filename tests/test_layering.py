"""What can be read off the source: import order, one door per package, sizes, names, docstrings.

The order is that of the design's layout; a file may import only files before it. Files yet to come are no error.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchblur

ROOT = Path(__file__).resolve().parents[1]
# lowest first; the design's list, finer
TORCHBLUR = [
    "check",
    "packed",
    "stopwatch",
    "cpu.jit",
    "shutter",
    "accuracy",
    "bernstein",
    "camera",
    "lights",
    "material",
    "scene",
    "backends",
    "casters",
    "atlas",
    "surfaces",
    "prisms",
    "cpu.bounds",
    "survey",
    "effects",
    "edges",
    "pairs",
    "intervals",
    "sort",
    "hidden",
    "subdivide",
    "cells",
    "texture",
    "lighting",
    "shading",
    "blocking",
    "cpu.polynomials",
    "cpu.shadow_rays",
    "cpu.sides",
    "cpu.still_sides",
    "cpu.sieve",
    "cpu.blocked",
    "cpu.join",
    "shadow_pairs",
    "shadows",
    "averages",
    "certificate",
    "paths",
    "texture_bends",
    "light_bends",
    "resting",
    "nodes",
    "resolve",
    "fragments",
    "cpu.motion",
    "cpu.raster",
    "cpu.lambert",
    "cpu.layers",
    "cpu.instant",
    "instant",
    "time_samples",
    "cpu.samples",
    "sampling",
    "metrics",
    "cpu.batch",
    "cpu.coverage",
    "cpu.sweep",
    "cpu.tiles",
    "cpu.fill",
    "cpu.blend",
    "cpu.curves",
    "cpu.receive",
    "cpu.bends",
    "cpu.panels",
    "cpu.settle",
    "cpu.shine",
    "cpu.quadrature",
    "cpu.expose",
    "ledger",
    "cpu.visibility",
    "exposure",
    "render",
    "ops",
]
DOORS = {  # third-party package: the only files that may import it (stems; "*" = all of the package)
    "torch": {"torchblur": "*", "datagen": "*"},
    "numpy": {"torchblur": "*", "datagen": "*"},
    "trimesh": {"datagen": {"assets"}},
    "OpenEXR": {"datagen": {"writer", "exr"}},
    "kornia": {"datagen": {"colour", "directional"}},
    "kornia_rs": {"datagen": {"flow_files"}},
    "h5py": {"datagen": {"flow_files"}},
    "lmdb": {"datagen": {"picture_store"}},
    "pydantic": {"datagen": {"spec"}},
    "tyro": {"datagen": {"__main__"}},
    "tqdm": {"datagen": {"progress"}},
    "PIL": {"datagen": "*"},
    "tomli": {"datagen": {"spec"}},
    "tomllib": {"datagen": {"spec"}},
    "ray": {"datagen": {"ray_executor"}},
    "pxr": {"datagen": {"usd_files"}},
    "numba": {"torchblur": {"jit"}},
    "matplotlib": {},
}
MAX_LINES = 350
MAX_PARAMETERS = 6
MORE_PARAMETERS = {
    "look_at": "the field's own signature for a camera",
    "orthographic": "the twin of look_at",
    "render": "all keywords but the first",
    "render_windows": "as render, and the windows",
    "accumulate": "what random draws, and how they are looked at",
}
BANNED_FILES = {"utils", "helpers", "common", "misc", "core", "manager", "data", "info"}
BANNED_TEXT = [r"\bissue\b", r"/work\b", r"\bbrief\b", r"\bTODO\b", r"\bFIXME\b", r"\bagent\b", r"/home/", r"/tmp/"]


def sources(package: str) -> list[Path]:
    """Return the Python files of a package."""
    return sorted((ROOT / package).rglob("*.py"))


ALL = [*sources("torchblur"), *sources("datagen")]
IDS = [str(p.relative_to(ROOT)) for p in ALL]


def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree: ast.Module) -> list[str]:
    """Return the full names of the modules that a tree imports, names imported from packages included."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            names += [f"{node.module}.{a.name}" for a in node.names]
    return names


def public_functions(tree: ast.Module) -> list[tuple[str, ast.AST]]:
    """Return functions, classes and methods whose name has no leading underscore, at module and class level."""
    found = []
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            found.append((node.name, node))
            if isinstance(node, ast.ClassDef):
                found += [
                    (f"{node.name}.{m.name}", m)
                    for m in node.body
                    if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")
                ]
    return found


def test_there_is_something_to_check():
    assert len(sources("torchblur")) > 10


@pytest.mark.parametrize("path", sources("torchblur"), ids=lambda p: p.name)
def test_torchblur_imports_run_one_way(path):
    if path.name == "__init__.py":
        return
    own = ".".join(path.relative_to(ROOT / "torchblur").with_suffix("").parts)
    assert own in TORCHBLUR, f"{own} has no place in the order of the layout"
    place = TORCHBLUR.index(own)
    for name in imported(tree_of(path)):
        parts = name.split(".")
        if parts[0] == "torchblur" and len(parts) > 1:
            if parts[1:] == ["cpu"]:
                continue
            module = next((m for m in (".".join(parts[1:3]), parts[1]) if m in TORCHBLUR), None)
            assert module is not None, f"{path.name} imports {name}"
            assert TORCHBLUR.index(module) < place, f"{path.name} imports {module}, which lies above it"
        assert parts[0] != "datagen", f"{path.name} imports {name}"


def test_package_file_of_torchblur_only_names():
    body = tree_of(ROOT / "torchblur" / "__init__.py").body
    assert all(isinstance(n, (ast.Expr, ast.Import, ast.ImportFrom, ast.Assign)) for n in body)


def test_datagen_has_no_import_cycle():
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in sources("datagen")}
    graph = {}
    for module, path in modules.items():
        names = {n if n in modules else n.rpartition(".")[0] for n in imported(tree_of(path))}
        graph[module] = {n for n in names if n in modules}
    done, trail = set(), []

    def visit(stem):
        assert stem not in trail, f"cycle: {[*trail, stem]}"
        if stem in done:
            return
        trail.append(stem)
        for other in sorted(graph.get(stem, ())):
            visit(other)
        trail.pop()
        done.add(stem)

    assert "datagen.baselines.gather" in graph["datagen.baselines.mcguire2012"]  # folders count too
    for stem in graph:
        if stem != "datagen.__init__":
            visit(stem)


@pytest.mark.parametrize("path", ALL, ids=IDS)
def test_each_package_has_one_door(path):
    package = path.relative_to(ROOT).parts[0]
    for name in imported(tree_of(path)):
        top = name.split(".")[0]
        if top in sys.stdlib_module_names and top not in DOORS:
            continue
        if top in ("torchblur", "datagen"):
            continue
        assert top in DOORS, f"{path.name} imports {top}, which has no door"
        allowed = DOORS[top].get(package, set())
        assert allowed == "*" or path.stem in allowed, f"{path.name} imports {top}; its door is {DOORS[top]}"


@pytest.mark.parametrize("path", ALL, ids=IDS)
def test_sizes(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES
    for node in ast.walk(tree_of(path)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            arguments = node.args
            names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
            count = len([n for n in names if n not in ("self", "cls")])
            assert count <= MAX_PARAMETERS or node.name in MORE_PARAMETERS, f"{node.name} has {count} parameters"


@pytest.mark.parametrize("path", ALL, ids=IDS)
def test_names_and_words(path):
    text = path.read_text(encoding="utf-8")
    assert path.stem not in BANNED_FILES
    assert "torch.nn" not in text
    assert "from torch import nn" not in text
    for pattern in BANNED_TEXT:
        found = re.search(pattern, text, re.IGNORECASE if pattern.islower() else 0)
        assert not found, f"{path.name} says {found.group()!r}"
    for node in ast.walk(tree_of(path)):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            assert not re.match(r"(process|do)_", node.name.lstrip("_")), node.name


@pytest.mark.parametrize("path", ALL, ids=IDS)
def test_docstrings(path):
    tree = tree_of(path)
    header = ast.get_docstring(tree)
    assert header, f"{path.name} has no header"
    assert header.splitlines()[0].strip().endswith((".", ":")) or ". " in header, "the first sentence has no end"
    for name, node in public_functions(tree):
        text = ast.get_docstring(node)
        assert text, f"{name} has no docstring"
        assert len(text.split()) >= 3, f"{name}: {text!r}"


@pytest.mark.parametrize("path", sources("torchblur"), ids=lambda p: p.name)
def test_what_computes_names_its_source(path):
    """A public function of more than a few statements says where it comes from, itself or in its module's header."""
    tree = tree_of(path)
    header = "Source" in (ast.get_docstring(tree) or "")
    for name, node in public_functions(tree):
        if isinstance(node, ast.FunctionDef) and path.stem not in ("check",):
            statements = sum(isinstance(n, ast.stmt) for n in ast.walk(node)) - 1
            assert header or statements <= 6 or "Source" in ast.get_docstring(node), name


def test_no_assert_guards_user_input():
    """`assert` vanishes under -O; checks of arguments raise."""
    for path in ALL:
        for name, node in public_functions(tree_of(path)):
            if isinstance(node, ast.FunctionDef):
                assert not any(isinstance(n, ast.Assert) for n in node.body[:3]), f"{path.name}: {name}"


def test_public_names_exist_and_are_documented():
    constructors = {"Accuracy", "Camera", "Material", "Mesh", "Scene", "Shutter"}
    functions = {"accumulate", "motion_to", "render", "render_instant", "stochastic"}
    assert constructors | functions <= set(torchblur.__all__)
    for name in torchblur.__all__:
        assert getattr(torchblur, name).__doc__, name


def test_oracles_import_nothing_of_ours():
    assert not [
        n for n in imported(tree_of(ROOT / "tests" / "oracles.py")) if n.split(".")[0] in ("torchblur", "torch")
    ]


def test_importing_torchblur_is_light():
    """Only torch and numpy: no renderer user should need the data set's packages."""
    heavy = ["kornia", "trimesh", "OpenEXR", "pydantic", "tyro", "PIL", "matplotlib"]
    program = f"import sys, torchblur; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
