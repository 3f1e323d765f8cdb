"""Who may import whom. The rules are those of docs/architecture.md, read from the source with `ast`."""

import ast
import configparser
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("jaxrender", "torchref", "fitting", "benchmarks")

GROUND = {
    "scene", "camera", "vecmath", "warp", "brdf", "metrics", "checks", "machine", "srgb", "sh_basis", "vec3", "latlong",
}  # fmt: skip
COMMANDS = {
    "__main__", "cli", "console", "denoise_command", "denoise_inputs", "denoise_page", "doctor", "quad_costs",
    "quads_command", "render_command", "trace_command", "trace_frames",
}  # fmt: skip

#: Part of jaxrender -> the other parts it may import. Data runs from the first line to the last.
MAY_IMPORT: dict[str, set[str]] = {
    "ground": set(),
    "animation": {"ground"},
    "io": {"ground", "animation"},
    "filters": {"ground"},
    "deferred": {"ground", "filters"},
    "pathtrace": {"ground", "filters", "deferred"},
    "harmonics": {"ground", "animation", "pathtrace"},
    "commands": {"ground", "animation", "io", "filters", "deferred", "pathtrace", "harmonics"},
}

#: Imports that break a rule, each for a reason. They must be inside a function.
LAZY_EXCEPTIONS = {
    # `jaxrender demo` and `jaxrender relight` are the front door to a job that `fitting` does.
    ("jaxrender.cli", "fitting.cli"),
}

#: Package on the index -> the name it is imported by, where they differ.
IMPORT_NAMES = {
    "scikit-image": "skimage",
    "pillow": "PIL",
    "openexr": "OpenEXR",
    "openimageio": "OpenImageIO",
}


def module_name(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(p): p for name in PACKAGES for p in sorted((ROOT / name).rglob("*.py"))}


def imports(name: str, *, lazy: bool) -> set[str]:
    """Absolute names of what a module imports: at its top, or (`lazy`) inside its functions."""
    tree = ast.parse(SOURCES[name].read_text(encoding="utf-8"))
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for node in ast.walk(function)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if (id(node) in inside) != lazy:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: imports are written in full, not relative"
            # `from package import module` and `from module import name` look alike.
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in SOURCES or node.module in PACKAGES else str(node.module))
    return found


def part_of(name: str) -> str:
    """The part of jaxrender a module belongs to."""
    parts = name.split(".")
    if len(parts) == 1:
        return "exports"
    if parts[1] in GROUND:
        return "ground"
    return "commands" if parts[1] in COMMANDS else parts[1]


def top(name: str) -> str:
    return name.split(".")[0]


OURS = sorted(name for name in SOURCES if top(name) == "jaxrender")


@pytest.mark.parametrize("name", OURS)
def test_jaxrender_flows_one_way(name):
    part = part_of(name)
    if part == "exports":
        return
    assert part in MAY_IMPORT, f"{name}: a new part of jaxrender needs its line in MAY_IMPORT and in the docs"
    allowed = MAY_IMPORT[part] | {part}
    for imported in imports(name, lazy=False) | imports(name, lazy=True):
        if top(imported) == "jaxrender":
            other = part_of(imported)
            assert other in allowed, f"{name} ({part}) imports {imported} ({other})"


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_packages_keep_apart(name):
    allowed = {
        "jaxrender": {"jaxrender"},
        "torchref": {"torchref"},
        "fitting": {"fitting", "jaxrender"},
        "benchmarks": set(PACKAGES),
    }[top(name)]
    for lazy in (False, True):
        for imported in imports(name, lazy=lazy):
            if lazy and (name, imported) in LAZY_EXCEPTIONS:
                continue
            assert top(imported) not in set(PACKAGES) - allowed, f"{name} imports {imported}"


def test_no_circles():
    graph = {n: {i for i in imports(n, lazy=False) if i in SOURCES and i != n} for n in SOURCES}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path, name])
        if name not in done:
            for imported in sorted(graph[name]):
                visit(imported, (*path, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def declared(section: str, key: str) -> set[str]:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    names = [re.split(r"[^A-Za-z0-9_.-]", line)[0] for line in config[section][key].split("\n") if line.strip()]
    return {IMPORT_NAMES.get(name.lower(), name.replace("-", "_")) for name in names}


@pytest.mark.parametrize("name", sorted(n for n in SOURCES if top(n) in ("jaxrender", "fitting", "torchref")))
def test_only_declared_dependencies_are_imported(name):
    core = declared("options", "install_requires") | set(PACKAGES) | set(sys.stdlib_module_names)
    # The twins need the extra "torch", safetensors for model files, and nothing else of ours.
    allowed = (
        {"torch", "numpy", "jaxtyping", "safetensors", "torchref", *sys.stdlib_module_names}
        if top(name) == "torchref"
        else core
    )
    extra = {i for i in imports(name, lazy=False) if top(i) not in allowed}
    assert not extra, f"{name} imports {extra}, which a plain installation may not have"


@pytest.mark.parametrize("name", OURS)
def test_kernels_do_not_print_nor_show_progress(name):
    if part_of(name) == "commands":
        return
    tree = ast.parse(SOURCES[name].read_text(encoding="utf-8"))
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "print"]
    assert not calls, f"{name}:{calls[0].lineno} prints"
    assert not {top(i) for i in imports(name, lazy=False)} & {"rich", "tyro"}


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_annotations_stay_real(name):
    assert "__future__" not in imports(name, lazy=False), f"{name}: jaxtyping needs annotations that are objects"


@pytest.mark.parametrize(
    ("package", "others"),
    [
        ("jaxrender.cli", {"torch", "kornia", "matplotlib", "fitting"}),
        ("torchref", {"jax", "jaxrender"}),
    ],
)
def test_importing_one_package_does_not_load_the_other(package, others):
    code = f"import sys, {package}; print(*sorted({others!r} & set(sys.modules)))"
    if package == "torchref":
        pytest.importorskip("torch")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.split() == []
