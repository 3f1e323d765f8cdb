"""jaxrender.deferred.quads and warps against the twins, kernel by kernel, and derivatives on common fragments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender.deferred import quads as ours
from jaxrender.deferred import raster
from jaxrender.deferred import samples as layouts
from tests.deferred.test_raster import soup
from tests.twins.agreement import cases_of, check
from torchref.deferred import quads as theirs
from torchref.deferred import raster as twin
from torchref.deferred import samples as twin_layouts


@pytest.mark.parametrize(("case", "dtype"), cases_of("deferred.quads.", "deferred.warps."))
def test_twin(case, dtype):
    check(case, dtype)


@pytest.mark.parametrize("name", ["center", "grid2"])
def test_quad_derivatives(rng, name):
    """Of a soup with w of 1 to 2: helper lanes reach far beyond small triangles, but not beyond their horizon."""
    clip, faces = soup(rng, 12, size=0.9)
    w = rng.uniform(1.0, 2.0, (len(clip), 1)).astype(np.float32)
    clip = clip / clip[:, 3:] * w
    values = rng.normal(size=(len(clip), 2)).astype(np.float32)
    layout, twin_layout = ((p.CENTER if name == "center" else p.ordered_grid(2)) for p in (layouts, twin_layouts))
    size = {"height": 11, "width": 14}
    fragments = raster.rasterize(jnp.asarray(clip), jnp.asarray(faces), **size, samples=layout)
    same = twin.rasterize(torch.tensor(clip), torch.tensor(faces).long(), **size, samples=twin_layout)
    agree = np.asarray(fragments.triangle_id) == same.triangle_id.numpy()
    assert agree.mean() > 0.99 and (np.asarray(fragments.triangle_id) >= 0).mean() > 0.15
    compiled = jax.jit(
        ours.quad_derivatives,
        static_argnames=("mode", "fine"),
        compiler_options={"xla_backend_optimization_level": 0},
    )
    for mode, fine in (("perspective", True), ("noperspective", False), ("flat_first", True)):
        got = compiled(fragments, jnp.asarray(values), mode=mode, fine=fine)
        expected = theirs.quad_derivatives(same, torch.tensor(values), mode=mode, fine=fine)
        for a, e in zip(got, expected, strict=True):
            a, e = np.asarray(a)[agree], e.numpy()[agree]
            # A difference of weights near 1 in float32, on slivers of weights far above.
            np.testing.assert_allclose(a, e, atol=2e-5, rtol=2e-3)
