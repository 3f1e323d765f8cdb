"""jaxrender.pathtrace and jaxrender.vec3 against the twin, kernel by kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from tests.support.asserts import assert_close, flatten
from tests.support.cases import CASES, Record
from tests.support.tolerances import TIGHT
from tests.twins import both
from tests.twins.agreement import cases_of, check


@pytest.mark.parametrize(("case", "dtype"), cases_of("vec3.", "pathtrace."))
def test_twin(case, dtype):
    check(case, dtype)


def slopes_of_jax(case, names, mix):
    with jax.enable_x64(True):
        at, rest = _parts(case, "jaxrender")

        def objective(free):
            result = both.public("jaxrender", case.kernel)(at._replace(**free), **rest)
            return sum(jnp.sum(x * m) for (_, x), m in zip(flatten(result), mix, strict=False))

        found = jax.jit(jax.grad(objective))({name: getattr(at, name) for name in names})
        return {path: np.asarray(x) for name in names for path, x in flatten(found[name], name)}


def slopes_of_torch(case, names, mix):
    at, rest = _parts(case, "torchref")
    leaves = [pair for name in names for pair in flatten(getattr(at, name), name)]
    for _, x in leaves:
        x.requires_grad_()
    result = both.public("torchref", case.kernel)(at, **rest)
    total = sum((x * torch.tensor(m)).sum() for (_, x), m in zip(flatten(result), mix, strict=False))
    found = torch.autograd.grad(total, [x for _, x in leaves], materialize_grads=True)
    return {path: x.numpy() for (path, _), x in zip(leaves, found, strict=True)}


def _parts(case, package):
    built = {
        name: both.record(x, package, np.float64) if isinstance(x, Record) else x for name, x in case.arguments.items()
    }
    make = jnp.asarray if package == "jaxrender" else torch.tensor
    built = {name: make(x) if isinstance(x, np.ndarray) else x for name, x in built.items()}
    return built.pop("at"), built


# Lambert's density has no material.
_SHADED = [
    case
    for case in CASES
    if case.kernel in ("pathtrace.scatter.evaluate", "pathtrace.scatter.density", "pathtrace.scatter.draw")
    and case.id != "scatter.density[lambert]"
]


@pytest.mark.parametrize("case", _SHADED, ids=lambda case: case.id)
def test_slopes_in_the_material(case):
    """Those in directions and normals differ off the unit sphere, where the formulas are free."""
    names = ("diffuse", "mirror", "roughness", "matt_share")
    mix = np.random.default_rng(8).normal(size=(7, 60))
    ours, theirs = (slopes(case, names, mix) for slopes in (slopes_of_jax, slopes_of_torch))
    assert any(x.any() for x in theirs.values())
    assert_close(ours, theirs, ulps=16.0 * TIGHT, what=case.id)  # slopes of lobes at their flanks
