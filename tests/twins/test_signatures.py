"""The two packages have the same public functions and records, and every kernel has a case."""

import dataclasses
import importlib
import inspect
import pathlib
import types
import typing
from typing import Any

import pytest

from tests.twins.agreement import kernels_with_a_case

ROOT = pathlib.Path(__file__).resolve().parents[2]

# What of jaxrender has a partner in torchref: whole rooms, and single modules. The rest of `animation` builds
# the data of the built-in body.
PAIRED = (
    "vecmath", "camera", "latlong", "metrics", "scene", "brdf", "harmonics.",
    "animation.skeleton", "animation.skinning",
    "deferred.samples", "deferred.texture", "deferred.quads", "deferred.warps", "deferred.gbuffer", "deferred.shade",
    "deferred.late", "deferred.metrics", "deferred.sampling", "deferred.clusters", "deferred.fxaa", "deferred.mlaa",
    "deferred.sraa", "deferred.highlights", "filters.", "vec3", "pathtrace.",
)  # fmt: skip
UNPAIRED_MODULES = {
    "harmonics.pipeline": "the order of the stages, no arithmetic",
    "filters.aovs": "a record of the host: images by name, and a check of shapes",
    "filters.denoiser": "runs on the host: the order of the kernels",
    "filters.settings": "settings of the denoiser, and the kernel they stand for",
    "filters.choice": "runs on the host: the choice of settings, by numbers found in searches",
    "filters.light": "runs on the host: which light is filtered",
    "filters.lamps": "runs on the host: what stands out in a picture",
    "filters.gaps": "runs on the host: guides where they are not finite",
    "filters.guides": "runs on the host: reads the extent of the scene off the images",
    "filters.bands": "pieces of an image; held against the whole in tests/filters",
    "filters.windows": "how jaxrender sums; torchref sums each window",
    "filters.precision": "torchref has its one rule",
    "filters.guided_rows": "what a CPU runs for guided_filter; held against filter_planes in tests/filters",
    "pathtrace.bvh": "a tree on device memory; judged against loops over triangles and Embree in tests/pathtrace",
    "pathtrace.bvh_build": "the same, built on the host",
    "pathtrace.traversal": "the same",
    "pathtrace.wavefront": "the same: how many rays step together",
    "pathtrace.instances": "the same, of several objects",
    "pathtrace.rays": "asks whichever backend there is",
    "pathtrace.hits": "a record of what a backend answers",
    "pathtrace.embree": "another library's rays; judged by brute force in tests/pathtrace",
    "pathtrace.backends": "which backend there is",
    "pathtrace.ray_scene": "what is asked of a backend",
    "pathtrace.embree_rays": "runs on the host: the order of traced rays",
    "pathtrace.tree_rays": "the same, of trees on device memory; judged against embree_rays in tests/pathtrace",
    "pathtrace.settings": "settings and their checks",
    "pathtrace.world": "a record of the host: a scene with its tables",
    "pathtrace.programs": "runs on the host: which kernels make a program, and rays in between",
    "pathtrace.guide_rays": "runs on the host: the order of the kernels",
    "pathtrace.render": "the same",
    "pathtrace.reprojection": "runs on the host: rays, and which pixels show the same surface",
}

# Public names without a partner, or with another signature.
EXCEPTIONS = {
    "scene.with_ground": "puts a record together on the host; judged in tests/io/test_animated_scene.py",
    "metrics.flip": "a library's; judged in tests/test_metrics.py",
    "vecmath.constant_like": "writes out broadcasts, which torch does by itself",
    "harmonics.sh.order_of": "a detail of how jaxrender reads an array's shape",
    "harmonics.sh.bands": "a table of jaxrender's own method",
    "harmonics.sh.rotation_table": "a table of jaxrender's own method; the twin rotates by projection",
    "harmonics.sh.sphere_quadrature": "torchref keeps its rules in a private file",
    "harmonics.zh_fit.greedy_axes": "where jaxrender starts its search; the twin starts from a grid",
    "harmonics.zh_fit.spread_start_axes": "the same",
    "harmonics.visibility.VisibilityCaster": "runs on the host: which rays are cast by whom",
    "harmonics.pose_model.model_arrays": "jaxrender writes and checks files; the twin only loads",
    "harmonics.pose_model.read_model_file": "the same",
    "harmonics.pose_model.model_hash": "the same",
    "deferred.quads.Quads": "of jaxrender's screen triangles, which the twin's Fragments do not hold",
    "deferred.quads.quad_coverage": "the same; judged by brute force in tests/deferred",
    "deferred.quads.visible_quads": "the same",
    "deferred.quads.visible_masks": "the same",
    "deferred.quads.draw_overdraw": "a picture for people",
    "deferred.gbuffer.AttributeTable": "jaxrender's own way: what it gathers by sample, in rows",
    "deferred.gbuffer.attribute_table": "the same",
    "deferred.gbuffer.gbuffer_rows": "jaxrender's own way: bands of an image",
    "deferred.gbuffer.rows_per_band": "the same",
    "deferred.gbuffer.with_motion": "a step of make_gbuffer, which is compared as a whole",
    "deferred.gbuffer.surface_points": "the same, for lists of fragments",
    "deferred.gbuffer.smooth_points": "the same",
    "deferred.gbuffer.mapped_normal": "the same",
    "deferred.gbuffer.turned_normal": "the same",
    "deferred.shade.surface_of_texels": "a step of look_up_surface, which is compared as a whole",
    "deferred.metrics.SampleMetrics": "settings of the pipeline",
    "deferred.clusters.Clusters": "settings of the pipeline",
    "deferred.clusters.is_uneven": "which windows are worth a second look; judged in tests/deferred/test_adaptive.py",
    "deferred.sampling.window_size": "a check of shapes",
    "deferred.late.draw_late": "a driver: finds fragments and calls the shader; judged in tests/deferred",
    "harmonics.sh.triple_product_tensor": "torchref's way to the product",
    "harmonics.zh.zonal_integral": "torchref integrates where jaxrender has closed forms",
    "pathtrace.ray_offset.moved_coordinates": "a step of offset_origin, which is compared as a whole",
    "filters.sat.mean_of": "against rounding, which torchref does not feel",
    "filters.guided.center_of": "the same",
    "filters.guided.filter_centered": "jaxrender's own way: pieces of an image",
    "filters.valid.check_images": "a check of shapes",
    "filters.bilateral.half_window": "jaxrender's own way: each pair of pixels once, planes as rows",
    "filters.bilateral.working_dtype": "the same",
    "filters.bilateral.sigma_values": "the same",
    "filters.bilateral.finite": "the same",
    "filters.bilateral.to_planes": "the same",
    "filters.bilateral.from_planes": "the same",
    "filters.bilateral.weighted_mean": "the same",
    "filters.bilateral.pair_sums": "the same",
    "filters.bilateral.Likeness": "the same",
    "pathtrace.hit_points.SurfaceTable": "the twin has no packed textures; its fields are the same otherwise",
    "pathtrace.hit_points.surface_table": "tables on the host; judged in tests/pathtrace/test_hit_points.py",
    "pathtrace.emitters.make_emitters": "tables on the host; judged in tests/pathtrace/test_emitters.py",
    "pathtrace.shadow_ratio.filtered_ratio": "the order of the kernels; makes guides on the host",
}

# Kernels with a partner that are compared in a test of their own.
COMPARED_APART = {
    "harmonics.zh_fit.fit_zh_lobes": "the search of each side ends at its own digits: judged by error",
    "harmonics.zh_fit.fit_shared_axes": "the same",
    "harmonics.pose_model.load_pose_model": "reads a file",
    "deferred.samples.ordered_grid": "field by field in tests/twins/test_raster.py",
    "deferred.samples.standard_pattern": "the same",
    "deferred.gbuffer.make_gbuffer": "on fragments that both sides share: tests/twins/test_shading.py",
    "deferred.late.resolve": "the same",
    "deferred.quads.quad_derivatives": "on fragments that each side rasterises: tests/twins/test_quads.py",
    "deferred.metrics.depth_sample_count": "in tests/twins/test_adaptive.py",
    "deferred.metrics.normal_sample_count": "in tests/twins/test_adaptive.py",
    "deferred.metrics.shading_sample_count": "in tests/twins/test_adaptive.py",
    "deferred.metrics.shading_steps": "in tests/twins/test_adaptive.py",
    "deferred.metrics.sample_count": "in tests/twins/test_adaptive.py",
    "deferred.metrics.balanced_counts": "in tests/twins/test_adaptive.py",
    "deferred.metrics.tile_maximum": "in tests/twins/test_adaptive.py",
    "deferred.metrics.average_over_frames": "in tests/twins/test_adaptive.py",
    "deferred.sampling.sample_positions": "in tests/twins/test_adaptive.py",
    "deferred.sampling.sample_rank": "in tests/twins/test_adaptive.py",
    "deferred.sampling.first_sample": "in tests/twins/test_adaptive.py",
    "deferred.sampling.prefix_points": "in tests/twins/test_adaptive.py",
    "deferred.sampling.cluster_points": "in tests/twins/test_adaptive.py",
    "deferred.sampling.resolve_samples": "in tests/twins/test_adaptive.py",
    "deferred.sampling.index_matrix": "in tests/twins/test_adaptive.py",
    "deferred.clusters.cluster_samples": "in tests/twins/test_adaptive.py",
    "deferred.clusters.cluster_quads": "in tests/twins/test_adaptive.py",
    "deferred.highlights.highlight_sample_count": "in tests/twins/test_adaptive.py",
    "deferred.metrics.normal_cone": "in tests/twins/test_adaptive.py",
    "deferred.clusters.shading_slope": "in tests/twins/test_adaptive.py",
    "deferred.fxaa.fxaa": "in tests/twins/test_antialiasing.py",
    "deferred.fxaa.luma": "in tests/twins/test_antialiasing.py",
    "deferred.fxaa.luma_range": "in tests/twins/test_antialiasing.py",
    "deferred.mlaa.mlaa": "in tests/twins/test_antialiasing.py",
    "deferred.sraa.sraa": "in tests/twins/test_antialiasing.py",
    "filters.valid.valid_pixels": "in tests/twins/test_filters.py",
}


def modules() -> list[str]:
    """Dotted names, without the package, of the modules that have a partner."""
    found = []
    for path in sorted((ROOT / "jaxrender").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT / "jaxrender").with_suffix("").parts)
        if name.startswith(PAIRED) and not name.endswith("__init__") and name not in UNPAIRED_MODULES:
            found.append(name)
    return found


def public_names(package: str, module: str) -> dict[str, Any]:
    """Functions and records that a module defines, by their full name without the package."""
    loaded = importlib.import_module(f"{package}.{module}")
    return {
        f"{module}.{name}": value
        for name, value in vars(loaded).items()
        if not name.startswith("_")
        and (inspect.isfunction(value) or _is_record(value))
        and value.__module__ == loaded.__name__
        and f"{module}.{name}" not in EXCEPTIONS
    }


def _is_record(value: Any) -> bool:
    """A frozen dataclass or a named tuple of ours; solvers that plug into lineax or optimistix are machinery."""
    machinery = [c for c in getattr(value, "__mro__", ()) if c.__module__.startswith(("lineax", "optimistix"))]
    return inspect.isclass(value) and (dataclasses.is_dataclass(value) or _is_named_tuple(value)) and not machinery


def _is_named_tuple(value: Any) -> bool:
    return issubclass(value, tuple) and hasattr(value, "_fields")


def pairs() -> list[str]:
    return [name for module in modules() for name in public_names("jaxrender", module)]


def spelled(annotation: Any) -> str:
    """An annotation without its package: dtype and axes of arrays, names of the rest."""
    if hasattr(annotation, "dim_str"):
        return f"{annotation.dtype.__name__}[{annotation.dim_str}]"
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return " | ".join(sorted(spelled(x) for x in typing.get_args(annotation)))
    if isinstance(annotation, list):
        return f"[{', '.join(spelled(x) for x in annotation)}]"
    if typing.get_args(annotation):
        inside = ", ".join(spelled(x) for x in typing.get_args(annotation))
        return f"{spelled(typing.get_origin(annotation))}[{inside}]"
    if inspect.isclass(annotation):
        array = annotation.__module__.startswith(("jax", "torch", "numpy")) and annotation.__name__ in (
            "Array",
            "ndarray",
            "Tensor",
        )
        return "array" if array else annotation.__name__
    return repr(annotation)


@pytest.mark.parametrize("module", modules())
def test_modules_offer_the_same_names(module):
    ours, theirs = (set(public_names(package, module)) for package in ("jaxrender", "torchref"))
    assert ours == theirs, f"only in jaxrender: {ours - theirs}, only in torchref: {theirs - ours}"


def test_torchref_has_no_module_of_its_own():
    for path in sorted((ROOT / "torchref").rglob("*.py")):
        partner = ROOT / "jaxrender" / path.relative_to(ROOT / "torchref")
        assert path.name.startswith("_") or partner.exists(), path


@pytest.mark.parametrize("name", pairs())
def test_signature(name):
    module = name.rpartition(".")[0]
    ours, theirs = (public_names(package, module).get(name) for package in ("jaxrender", "torchref"))
    assert theirs is not None, f"torchref lacks {name}"
    if dataclasses.is_dataclass(ours):
        fields = [[(f.name, spelled(f.type)) for f in dataclasses.fields(x)] for x in (ours, theirs)]
        assert fields[0] == fields[1]
        assert ours.__dataclass_params__.frozen and theirs.__dataclass_params__.frozen
        return
    if inspect.isclass(ours):
        fields = [[(name, spelled(kind)) for name, kind in x.__annotations__.items()] for x in (ours, theirs)]
        assert fields[0] == fields[1]
        return
    signatures = [inspect.signature(x) for x in (ours, theirs)]
    parameters = [
        [(p.name, p.kind.name, p.default, spelled(p.annotation)) for p in s.parameters.values()] for s in signatures
    ]
    assert parameters[0] == parameters[1]
    assert spelled(signatures[0].return_annotation) == spelled(signatures[1].return_annotation)


def test_every_kernel_has_a_case():
    kernels = {
        name
        for module in modules()
        for name, value in public_names("jaxrender", module).items()
        if inspect.isfunction(value)
    }
    missing = kernels - kernels_with_a_case() - set(COMPARED_APART)
    assert not missing, f"add a case to tests/support/cases.py for {sorted(missing)}"


def test_the_lists_of_exceptions_are_alive():
    """An exception whose name is gone from both packages is dropped from the list."""
    for name in [*EXCEPTIONS, *COMPARED_APART]:
        module, _, attribute = name.rpartition(".")
        loaded = [importlib.import_module(f"{package}.{module}") for package in ("jaxrender", "torchref")]
        assert any(hasattr(x, attribute) for x in loaded), name
