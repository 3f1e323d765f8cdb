"""Vectors and frames: values, and finite values and derivatives where a division or a root meets zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxrender import harmonics, vecmath
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING

normalize = jax.jit(vecmath.normalize)
orthonormal_tangent = jax.jit(vecmath.orthonormal_tangent)
frame_from_normal_tangent = jax.jit(vecmath.frame_from_normal_tangent)
reflection_frame = jax.jit(vecmath.reflection_frame)


def unit_vectors(rng, n):
    """Random ones after the axes, and some next to the pole where a frame is singular."""
    v = np.concatenate(
        [np.eye(3), -np.eye(3), [[1e-9, 0, 1], [1e-9, 1e-8, -1], [1, 0, -1e-9]], rng.normal(size=(n, 3))]
    )
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def assert_rotations(frames, dtype):
    frames = np.asarray(frames, np.float64)
    products = np.swapaxes(frames, -1, -2) @ frames
    assert_close(products, np.broadcast_to(np.eye(3), frames.shape), ulps=16, dtype=dtype)
    assert_close(np.linalg.det(frames), np.ones(frames.shape[:-2]), ulps=16, dtype=dtype)


def every_kernel(v, w):
    """All functions of the file on two batches (n, 3) of unit vectors with positive components."""
    return (
        vecmath.safe_sqrt(v),
        vecmath.safe_div(v, w),
        vecmath.dot(v, w),
        vecmath.normalize(3.0 * v),
        vecmath.orthonormal_tangent(v),
        vecmath.frame_from_normal_tangent(v, w),
        vecmath.reflection_frame(v, w),
    )


def test_jit_is_eager_and_vmap_is_a_loop(rng, dtype):
    v, w = (np.abs(x) / np.linalg.norm(x, axis=-1, keepdims=True) for x in rng.normal(size=(2, 3, 3)))
    v, w = jnp.asarray(v, dtype), jnp.asarray(w, dtype)
    eager = every_kernel(v, w)
    assert all(x.dtype == dtype for x in eager)
    # Compiled code may fuse a product and a sum into one rounding.
    compiled = jax.jit(every_kernel)
    assert_close(compiled(v, w), eager, ulps=8, dtype=dtype)
    assert_close(jax.jit(jax.vmap(every_kernel))(v, w), eager, ulps=8, dtype=dtype)
    looped = jax.tree.map(lambda *rows: jnp.stack(rows), *(compiled(v[i], w[i]) for i in range(3)))
    assert_close(looped, eager, ulps=8, dtype=dtype)


def test_dot_keeps_its_axis_and_broadcasts(rng, dtype):
    a, b = rng.normal(size=(4, 1, 3)), rng.normal(size=(1, 5, 3))
    got = vecmath.dot(jnp.asarray(a, dtype), jnp.asarray(b, dtype))
    assert_close(got, np.sum(a * b, axis=-1, keepdims=True), ulps=ROUNDING, dtype=dtype)


def test_safe_sqrt_at_and_below_zero(dtype):
    x = jnp.asarray([4.0, 0.0, -1.0, 1e-30], dtype)
    assert_close(vecmath.safe_sqrt(x), np.array([2.0, 0.0, 0.0, 1e-15]), ulps=2, dtype=dtype, entrywise=True)
    slopes = jax.grad(lambda x: jnp.sum(vecmath.safe_sqrt(x)))(x)
    assert_close(slopes, np.array([0.25, 0.0, 0.0, 5e14]), ulps=4, dtype=dtype, entrywise=True)


def test_safe_div_by_zero(dtype):
    a, b = jnp.asarray([3.0, 3.0, 0.0], dtype), jnp.asarray([2.0, 0.0, 0.0], dtype)
    assert vecmath.safe_div(a, b).tolist() == [1.5, 0.0, 0.0]
    in_a, in_b = jax.grad(lambda a, b: jnp.sum(vecmath.safe_div(a, b)), argnums=(0, 1))(a, b)
    assert in_a.tolist() == [0.5, 0.0, 0.0]
    assert in_b.tolist() == [-0.75, 0.0, 0.0]


def test_normalize_keeps_direction_and_zero(rng, dtype):
    v = np.concatenate([rng.normal(size=(6, 3)) * 10.0 ** rng.uniform(-15, 15, size=(6, 1)), np.zeros((1, 3))])
    got = np.asarray(normalize(jnp.asarray(v, dtype)), np.float64)
    assert_close(got[:-1], v[:-1] / np.linalg.norm(v[:-1], axis=-1, keepdims=True), ulps=8, dtype=dtype)
    assert (got[-1] == 0).all()
    slope = jax.jit(jax.jacrev(vecmath.normalize))(jnp.zeros(3, dtype))
    assert (np.asarray(slope) == 0).all()


def test_gradients_match_finite_differences(rng):
    with jax.enable_x64(True):
        v, n, t = rng.normal(size=(3, 2, 3))
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        check_grads(normalize, (v,), order=1, modes=["rev"])
        check_grads(orthonormal_tangent, (n,), order=1, modes=["rev"])
        check_grads(frame_from_normal_tangent, (n, t), order=1, modes=["rev"])
        check_grads(reflection_frame, (v, n), order=1, modes=["rev"])


def test_tangent_is_unit_and_orthogonal_everywhere(rng, dtype):
    n = jnp.asarray(unit_vectors(rng, 200), dtype)
    t = orthonormal_tangent(n)
    assert_rotations(jnp.stack([t, jnp.cross(n, t), n], axis=-1), dtype)
    slopes = jax.jit(jax.vmap(jax.jacfwd(vecmath.orthonormal_tangent)))(n)
    assert np.isfinite(np.asarray(slopes)).all()


def test_tangent_is_continuous_on_each_half(rng):
    n = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.6, 0.8, 1e-4]])
    near = n + 1e-5 * rng.normal(size=n.shape)
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    apart = orthonormal_tangent(jnp.asarray(n)) - orthonormal_tangent(jnp.asarray(near))
    # The derivative is of modulus 2 at most.
    assert np.abs(np.asarray(apart)).max() < 1e-4


def test_frame_has_the_normal_as_z_and_keeps_the_tangent(rng, dtype):
    n, t = unit_vectors(rng, 50), rng.normal(size=(59, 3))
    frames = frame_from_normal_tangent(jnp.asarray(n, dtype), jnp.asarray(t, dtype))
    assert_rotations(frames, dtype)
    assert_close(frames[..., 2], jnp.asarray(n, dtype), ulps=0, dtype=dtype)
    # x lies in the half plane of normal and tangent.
    x = np.asarray(frames[..., 0], np.float64)
    expected = t - np.sum(n * t, axis=-1, keepdims=True) * n
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert_close(x, expected, ulps=ROUNDING, dtype=dtype)


def test_frame_of_a_lost_or_nearly_parallel_tangent_is_a_rotation(rng, dtype):
    n = unit_vectors(rng, 50)
    sideways = [3.0 * n + angle * rng.normal(size=n.shape) for angle in (0.0, 1e-9, 1e-6, 3e-6, 1e-5, 1e-3)]
    t = np.stack([*sideways, np.zeros_like(n)])
    arguments = jnp.asarray(np.broadcast_to(n, t.shape), dtype), jnp.asarray(t, dtype)
    assert_rotations(frame_from_normal_tangent(*arguments), dtype)
    total = lambda n, t: jnp.sum(vecmath.frame_from_normal_tangent(n, t)[..., :2] ** 3)  # noqa: E731
    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(*arguments)
    assert all(np.isfinite(np.asarray(x)).all() for x in slopes)


def test_reflection_frame_mirrors_the_view(rng, dtype):
    n, wo = unit_vectors(rng, 40), unit_vectors(rng, 40)[::-1]
    frames = reflection_frame(jnp.asarray(wo, dtype), jnp.asarray(n, dtype))
    assert_rotations(frames, dtype)
    mirrored = 2.0 * np.sum(n * wo, axis=-1, keepdims=True) * n - wo
    assert_close(frames[..., 2], mirrored, ulps=ROUNDING, dtype=dtype)
    # Seen along the normal the mirror image is the normal; at grazing angles it runs away from the eye.
    straight = reflection_frame(jnp.asarray(n, dtype), jnp.asarray(n, dtype))[..., 2]
    assert_close(straight, n, ulps=8, dtype=dtype)
    grazing = reflection_frame(jnp.asarray([1.0, 0, 0], dtype), jnp.asarray([0, 0, 1.0], dtype))
    assert grazing[:, 2].tolist() == [-1.0, 0.0, 0.0]


def test_constant_like_takes_rank_and_dtype():
    x = jnp.zeros((2, 3, 4), jnp.float32)
    constant = vecmath.constant_like(np.arange(4), x)
    assert constant.shape == (1, 1, 4)
    assert constant.dtype == jnp.float32
    assert (x + constant)[1, 2].tolist() == [0, 1, 2, 3]


def contractions(jaxpr):
    """Every dot_general in a jaxpr and in those inside it."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from contractions(inner)


def _basis(g=2, n=5, k=3):
    return harmonics.FeatureBasis(
        "given", 1.0, jnp.zeros(0, int), jnp.zeros(g, int), jnp.zeros((g, 0)), jnp.zeros((0, 4)),
        jnp.zeros((0, 3)), jnp.zeros((g, n)), jnp.zeros((g, n, k)),
    )  # fmt: skip


PRODUCTS = {
    "sh_project": (
        lambda v, d, w: harmonics.sh_project(v, d, w, order=4),
        [jnp.ones((2, 9)), jnp.ones((9, 3)), jnp.ones(9)],
    ),
    "sh_rotate": (harmonics.sh_rotate, [jnp.ones(36), jnp.eye(3)]),
    "sh_product": (harmonics.sh_product, [jnp.ones(16), jnp.ones(16)]),
    "to scipy": (lambda v: harmonics.sh_to_layout(v, "scipy"), [jnp.ones(16)]),
    "from e3nn": (lambda v: harmonics.sh_from_layout(v, "e3nn"), [jnp.ones(16)]),
    "phong_operator": (harmonics.phong_operator, [jnp.ones(2)]),
    "brdf_operator": (lambda a: harmonics.brdf_operator(lambda x: x**a), [jnp.ones(())]),
    "apply_operator": (harmonics.apply_operator, [jnp.ones((16, 16)), jnp.ones(16)]),
    "project_environment": (lambda x: harmonics.project_environment(x, order=4), [jnp.ones((4, 8, 3))]),
    "project_visibility": (
        harmonics.project_visibility,
        [jnp.zeros((2, 2), jnp.uint8), jnp.ones((16, 16))],
    ),
    "fit_linear": (lambda a, b: harmonics.fit_linear(a, b, ridge=0.1), [jnp.eye(5), jnp.ones((5, 2))]),
    "fit_linear, wide": (
        lambda a, b: harmonics.fit_linear(a, b, ridge=0.1),
        [jnp.eye(5, 9), jnp.ones((5, 2))],
    ),
    "predict_linear": (
        lambda w, a: harmonics.predict_linear(harmonics.LinearFit(w, jnp.ones(2), jnp.zeros((), int), jnp.ones(())), a),
        [jnp.ones((5, 2)), jnp.ones((3, 5))],
    ),
    "project_features": (lambda raw: harmonics.project_features(_basis(), raw), [jnp.ones((2, 5))]),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_contractions_ask_for_full_precision(name):
    """By default a GPU rounds the factors of a float32 product to 10 bits, a TPU to 7."""
    function, arguments = PRODUCTS[name]
    found = list(contractions(jax.make_jaxpr(function)(*arguments).jaxpr))
    assert found, "nothing was multiplied"
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    assert all(equation.params["precision"] == highest for equation in found)
