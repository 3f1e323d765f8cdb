"""What is installed, what it runs on, and what more there would be: the answer of `jaxrender doctor`."""

import importlib.metadata
import importlib.util
import os
import platform
import re
from typing import Any

import jax
import numpy as np

import jaxrender.machine

#: The packages a result depends on.
PACKAGES = (
    "jaxrender", "jax", "jaxlib", "numpy", "equinox", "lineax", "optimistix", "trimesh", "embreex",
    "scikit-image", "pygltflib", "OpenEXR", "OpenImageIO", "pillow", "safetensors", "zarr", "tyro", "rich",
)  # fmt: skip

#: What each extra adds, in the user's words.
EXTRAS = {
    "torch": "the readable PyTorch twins (torchref) and kornia to compare with",
    "plots": "plots in the HTML reports, the chart of `jaxrender quads`",
    "peers": "other libraries that the benchmarks and tests measure against",
    "cluster": "baking on several machines",
    "dev": "the test runner, linter and type checker",
}


def examine() -> dict[str, Any]:
    """Looks at everything and returns it as JSON data; nothing it finds missing makes it fail."""
    return {
        "python": platform.python_version(),
        "machine": examine_machine(),
        "packages": {name: package_version(name) for name in PACKAGES},
        "devices": _examine_devices(),
        "rays": _examine_rays(),
        "compilation_cache": _examine_cache(),
        "extras": _examine_extras(),
    }


def examine_machine() -> dict[str, Any]:
    """System, processor, the cores this process may use, and memory."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": jaxrender.machine.cpu_model(),
        "cores": jaxrender.machine.num_cores(),
        "memory_bytes": memory,
    }


def package_version(name: str) -> str | None:
    """The installed version of a package, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def problems(found: dict[str, Any]) -> list[str]:
    """What keeps a command from working, one line each; empty if all is well."""
    lines = [f"the package {name} is missing" for name, version in found["packages"].items() if version is None]
    if found["devices"]["error"]:
        lines.append(f"JAX has no device: {found['devices']['error']}")
    if not found["rays"]["works"]:
        lines.append(f"no ray backend, so nothing can be baked: {found['rays']['error']}")
    if not found["compilation_cache"]["writable"]:
        lines.append(f"the compilation cache {found['compilation_cache']['path']} cannot be written")
    return lines


def _examine_devices() -> dict[str, Any]:
    try:
        devices = [{"platform": d.platform, "kind": d.device_kind, "id": d.id} for d in jax.devices()]
        return {"backend": jax.default_backend(), "devices": devices, "error": None}
    except RuntimeError as error:
        return {"backend": None, "devices": [], "error": " ".join(str(error).split())}


def _examine_rays() -> dict[str, Any]:
    """Shoots two rays at one triangle: an installed Embree may still not load."""
    found: dict[str, Any] = {
        "backend": "Embree (embreex)",
        "version": package_version("embreex"),
        "threads": jaxrender.machine.num_cores(),
        "works": False,
        "error": None,
    }
    try:
        from embreex import mesh_construction, rtcore_scene

        scene = rtcore_scene.EmbreeScene(robust=True)
        corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
        mesh = mesh_construction.TriangleMesh(scene, corners, np.array([[0, 1, 2]], np.int32))
        origins = np.array([[0, 0, 1], [5, 0, 1]], np.float32)
        hit = scene.run(origins, np.tile(np.array([[0, 0, -1]], np.float32), (2, 1)))
        del mesh
        found["works"] = list(hit) == [0, -1]
        if not found["works"]:
            found["error"] = f"two test rays gave {list(hit)} instead of [0, -1]"
    except Exception as error:
        found["error"] = f"{type(error).__name__}: {error}"
    return found


def _examine_cache() -> dict[str, Any]:
    path = jaxrender.machine.cache_path()
    sizes = []
    for file in path.glob("**/*"):
        try:
            sizes.append(file.stat().st_size if file.is_file() else 0)
        except OSError:  # another process may have removed it
            continue
    return {
        "path": str(path),
        "writable": jaxrender.machine.is_writable_folder(path),
        "bytes": sum(sizes),
        "programs": sum(1 for _ in path.glob("*-cache")),
    }


def _examine_extras() -> list[dict[str, Any]]:
    """The extras as the installed metadata lists them, so that they cannot differ from setup.cfg."""
    members: dict[str, list[str]] = {name: [] for name in EXTRAS}
    try:
        required = importlib.metadata.requires("jaxrender") or []
    except importlib.metadata.PackageNotFoundError:
        required = []
    for line in required:
        found = re.match(r"([A-Za-z0-9_.-]+).*;.*extra\s*==\s*[\"']([^\"']+)[\"']", line)
        if found and found[1].lower() != "jaxrender":
            members.setdefault(found[2], []).append(found[1])
    return [
        {
            "name": extra,
            "adds": EXTRAS.get(extra, ""),
            "missing": [name for name in names if package_version(name) is None],
            "install": f'pip install ".[{extra}]"',
        }
        for extra, names in members.items()
    ]
