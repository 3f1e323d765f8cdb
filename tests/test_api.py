"""The house rules of the public functions, and the names that others rely on."""

import importlib
import inspect
import pkgutil

import pytest

import jaxrender

#: Folders and files of pure kernels. Their rules are the strictest.
KERNELS = (
    "jaxrender.vecmath", "jaxrender.vec3", "jaxrender.warp", "jaxrender.brdf", "jaxrender.camera", "jaxrender.latlong",
    "jaxrender.metrics",
    "jaxrender.animation", "jaxrender.filters", "jaxrender.deferred", "jaxrender.pathtrace",
    "jaxrender.harmonics",
)  # fmt: skip

#: Module -> name -> its parameters as promised: options after "*", any further options may follow.
PROMISED = {
    "jaxrender.harmonics": {
        "sh_basis": ("directions", "*", "order"),
        "sh_rotate": ("sh", "rotation"),
        "zh_to_sh": ("coefficients", "axis"),
        "phong_operator": ("exponent", "*", "order"),
        "phong_normalization": ("exponent",),
        "brdf_operator": ("kernel", "*", "order", "num_nodes"),
        "project_environment": ("image", "*", "order"),
        "fit_zh_lobes": ("sh", "*", "num_lobes", "order"),
        "fit_linear": ("features", "targets", "*", "ridge"),
        "relight": None,
        "membrane": None,
    },
    "jaxrender.deferred": {
        "rasterize": ("clip", "faces", "*", "height", "width", "samples", "cull"),
        "interpolate": ("fragments", "attributes", "*", "mode"),
        "ddx": ("values", "*", "fine"),
        "ddy": ("values", "*", "fine"),
        "sample_texture_grad": ("textures", "uv", "duv_dx", "duv_dy", "*", "max_anisotropy"),
    },
    "jaxrender.io": {
        "load_scene": ("path",),
        "load_character": ("path",),
        "load_bvh": ("path",),
        "read_exr": ("path",),
        "write_exr": ("path", "image"),
        "write_png": ("path", "image"),
    },
    "jaxrender.metrics": {
        "mse": ("image", "reference"),
        "psnr": ("image", "reference", "*", "peak"),
        "ssim": ("image", "reference", "*", "peak"),
        "flip": ("image", "reference"),
        "heatmap": ("values",),
    },
    "jaxrender.filters": {
        "summed_area_table": ("image",),
        "box_mean": ("image", "*", "radius"),
        "guided_filter": ("guide", "image", "*", "radius", "eps"),
        "cross_bilateral_filter": ("image", "features", "*", "radius", "sigma_spatial", "sigma_features"),
        "atrous_filter": ("image", "features", "*", "num_levels", "sigma_features", "sigma_color"),
    },
}

DEFAULTS = {
    ("jaxrender.harmonics", "phong_operator", "order"): 4,
    ("jaxrender.harmonics", "brdf_operator", "order"): 4,
    ("jaxrender.metrics", "psnr", "peak"): 1.0,
    ("jaxrender.filters", "atrous_filter", "sigma_color"): None,
}

MODULES = sorted(m.name for m in pkgutil.walk_packages(jaxrender.__path__, "jaxrender."))


def public_members(module_name):
    """Public functions and classes that are defined in a module (not merely imported there)."""
    module = importlib.import_module(module_name)
    for name, member in vars(module).items():
        if name.startswith("_") or getattr(member, "__module__", None) != module_name:
            continue
        if inspect.isfunction(member) or inspect.isclass(member):
            yield name, member


FUNCTIONS = [
    pytest.param(function, id=f"{module}.{name}")
    for module in MODULES
    if module.startswith(KERNELS)
    for name, function in public_members(module)
    if inspect.isfunction(function)
]


@pytest.mark.parametrize("module", MODULES)
def test_everything_public_has_a_docstring(module):
    if list(public_members(module)):
        assert importlib.import_module(module).__doc__, f"{module} does not say what its job is"
    for name, member in public_members(module):
        # A dataclass without a docstring gets its own signature as one.
        text = member.__doc__ or ""
        assert text.strip() and not text.startswith(f"{name}("), f"{module}.{name} has no docstring"
        if inspect.isclass(member):
            for attribute, value in vars(member).items():
                function = value.fget if isinstance(value, property) else value
                own = inspect.isfunction(function) and function.__module__ == module
                if own and not attribute.startswith("_") and attribute not in ("run",):
                    assert function.__doc__ or isinstance(value, property), f"{module}.{name}.{attribute}"


@pytest.mark.parametrize("function", FUNCTIONS)
def test_options_of_kernels_are_keyword_only(function):
    for parameter in inspect.signature(function).parameters.values():
        if parameter.default is not inspect.Parameter.empty:
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, parameter.name


@pytest.mark.parametrize("function", FUNCTIONS)
def test_kernels_say_their_shapes(function):
    signature = inspect.signature(function)
    missing = [p.name for p in signature.parameters.values() if p.annotation is inspect.Parameter.empty]
    assert not missing and signature.return_annotation is not inspect.Signature.empty, missing


@pytest.mark.parametrize(("module", "name"), [(m, n) for m, names in PROMISED.items() for n in names])
def test_promised_names_and_parameters(module, name):
    function = getattr(importlib.import_module(module), name)
    assert callable(function)
    promised = PROMISED[module][name]
    if promised is None:
        return
    given = inspect.signature(function).parameters
    positional = [p.name for p in given.values() if p.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD]
    options = {p.name for p in given.values() if p.kind is inspect.Parameter.KEYWORD_ONLY}
    split = promised.index("*") if "*" in promised else len(promised)
    assert tuple(positional) == promised[:split]
    assert set(promised[split + 1 :]) <= options


@pytest.mark.parametrize(("module", "name", "option"), DEFAULTS)
def test_promised_defaults(module, name, option):
    function = getattr(importlib.import_module(module), name)
    assert inspect.signature(function).parameters[option].default == DEFAULTS[module, name, option]
