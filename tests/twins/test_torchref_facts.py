"""torchref against closed forms, printed tables and brute-force NumPy: agreement of twins is not truth."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import TIGHT
from torchref import camera, latlong, metrics, vecmath
from torchref.animation import skeleton, skinning
from torchref.harmonics import (
    brdf_operator,
    light,
    linear_model,
    membrane,
    relight,
    sh,
    visibility,
    zh,
    zh_fit,
)
from torchref.scene import make_mesh_sequence, vertex_normals


def tensor(array) -> Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float64)


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    return q * np.linalg.det(q)[:, None, None]


def test_imports_without_jax():
    modules = [m for m in sys.modules if m.startswith("torchref")]
    code = f"import sys; sys.modules['jax'] = None\nfor m in {modules!r}: __import__(m)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=_root())


def _root() -> str:
    import torchref

    return str(next(iter(torchref.__path__))).removesuffix("torchref")


# --- spherical harmonics
# ---------------------------------------------------------------------------------------


def test_basis_is_the_one_of_scipy_and_of_the_definition(rng):
    directions = np.concatenate([unit(rng, 40), np.eye(3), -np.eye(3)])
    theta, phi = (
        np.arccos(directions[:, 2].clip(-1, 1)),
        np.arctan2(directions[:, 1], directions[:, 0]),
    )
    columns = []
    for l in range(11):
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi)
            columns.append(y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag))
    got = sh.sh_basis(tensor(directions), order=11)
    assert_close(got, np.stack(columns, -1), ulps=TIGHT)
    assert_close(got, oracles.real_harmonics(directions, 11), ulps=TIGHT)


def test_basis_constants_of_the_table(rng):
    x, y, z = unit(rng, 20).T
    table = [
        0.2820947918 * np.ones_like(x),
        -0.4886025119 * y,
        0.4886025119 * z,
        -0.4886025119 * x,
        1.0925484306 * x * y,
        -1.0925484306 * y * z,
        0.3153915653 * (3 * z * z - 1),
        -1.0925484306 * x * z,
        0.5462742153 * (x * x - y * y),
        -0.5900435899 * y * (3 * x * x - y * y),
        2.8906114426 * x * y * z,
        -0.4570457995 * y * (5 * z * z - 1),
        0.3731763326 * z * (5 * z * z - 3),
        -0.4570457995 * x * (5 * z * z - 1),
        1.4453057213 * z * (x * x - y * y),
        -0.5900435899 * x * (x * x - 3 * y * y),
    ]
    got = sh.sh_basis(tensor(np.stack([x, y, z], -1)), order=4)
    np.testing.assert_allclose(got, np.stack(table, -1), atol=2e-10)  # the table has ten decimals


def test_basis_is_orthonormal():
    directions, weights = oracles.sphere_rule(18)
    y = sh.sh_basis(tensor(directions), order=10).numpy()
    assert_close(y.T @ (weights[:, None] * y), np.eye(100), ulps=TIGHT)


def test_rotation_moves_the_function(rng):
    f, r, s = tensor(rng.normal(size=(5, 49))), tensor(rotations(rng, 5)), tensor(unit(rng, 5))
    moved = torch.einsum("...ij,...j->...i", r, s)
    assert_close(sh.sh_evaluate(sh.sh_rotate(f, r), moved), sh.sh_evaluate(f, s), ulps=TIGHT)


def test_triple_products_have_the_known_number_of_nonzeros():
    for order, nonzeros, unique in ((3, 83, 25), (4, 353, 77)):
        triple = sh.triple_product_tensor(order, order, order)
        assert_close(triple, oracles.triple_products(order), ulps=TIGHT)
        index = np.argwhere(np.abs(triple) > 1e-12)
        assert len(index) == nonzeros
        assert len({tuple(sorted(i)) for i in index.tolist()}) == unique


def test_product_is_the_pointwise_product(rng):
    a, b, s = (tensor(x) for x in (rng.normal(size=(3, 9)), rng.normal(size=(3, 16)), unit(rng, 3)))
    whole = sh.sh_product(a, b, order=6)
    assert_close(sh.sh_evaluate(whole, s), sh.sh_evaluate(a, s) * sh.sh_evaluate(b, s), ulps=TIGHT)
    assert_close(sh.sh_product(a, b), whole[:, :9], ulps=TIGHT)


def test_layout_of_gaussian_splatting(rng):
    """3D Gaussian Splatting's eval_sh to degree 3: its constants, its order of terms."""
    c = rng.normal(size=16)
    x, y, z = direction = unit(rng)
    xx, yy, zz = x * x, y * y, z * z
    c2 = (
        1.0925484305920792,
        -1.0925484305920792,
        0.31539156525252005,
        -1.0925484305920792,
        0.5462742152960396,
    )
    c3 = (
        -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
        1.445305721320277, -0.5900435899266435,
    )  # fmt: skip
    value = 0.28209479177387814 * c[0] + 0.4886025119029199 * (-y * c[1] + z * c[2] - x * c[3])
    value += np.dot([x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy] * np.array(c2), c[4:9])
    value += np.dot(
        np.array(c3)
        * [
            y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy),
            x * (4 * zz - xx - yy), z * (xx - yy), x * (xx - 3 * yy),
        ],
        c[9:],
    )  # fmt: skip
    theirs = sh.sh_to_layout(tensor(c), "gaussian_splatting")
    assert_close(sh.sh_evaluate(theirs, tensor(direction)), value, ulps=TIGHT)


def test_layout_of_scipy(rng):
    c, s = tensor(rng.normal(size=36)), unit(rng, 7)
    theirs = sh.sh_to_layout(c, "scipy").numpy()
    theta, phi = np.arccos(s[:, 2]), np.arctan2(s[:, 1], s[:, 0])
    value = sum(theirs[l * (l + 1) + m] * sph_harm_y(l, m, theta, phi) for l in range(6) for m in range(-l, l + 1))
    assert_close(value, sh.sh_evaluate(c, tensor(s)).numpy().astype(complex), ulps=TIGHT)


def test_layout_of_the_positive_table(rng):
    c, (x, y, z) = rng.normal(size=4), unit(rng)
    theirs = sh.sh_to_layout(tensor(c), "positive").numpy()
    value = 0.5 / math.sqrt(math.pi) * theirs[0] + math.sqrt(0.75 / math.pi) * (theirs[1:] @ [y, z, x])
    assert_close(sh.sh_evaluate(tensor(c), tensor([x, y, z])), value, ulps=TIGHT)


@pytest.mark.parametrize("layout", sh.LAYOUTS)
def test_layouts_come_back(rng, layout):
    c = tensor(rng.normal(size=(2, 100)))
    assert_close(sh.sh_from_layout(sh.sh_to_layout(c, layout), layout), c, ulps=TIGHT)


# --- zonal harmonics
# -------------------------------------------------------------------------------------------


def test_standard_zonal_vectors():
    p, s = math.pi, math.sqrt
    clamped = [s(p) / 2, s(p / 3), s(5 * p) / 8, 0.0, -s(p) / 16]
    assert_close(zh.clamped_cosine_zh(order=5).double(), clamped, ulps=16, dtype=np.float32)
    upper = [s(p), s(3 * p) / 2, 0.0, -s(7 * p) / 8]
    assert_close(zh.hemisphere_zh(order=4).double(), upper, ulps=16, dtype=np.float32)


@pytest.mark.parametrize("alpha", [0.0, 0.37, 1.0, 2.0, 3.7, 16.0, 1000.0])
def test_phong_zonal_vector(alpha):
    a = [None, *(alpha + i for i in range(1, 6))]
    rho = [
        1.0,
        a[1] / a[2],
        alpha / a[3],
        a[1] * (alpha - 1) / (a[2] * a[4]),
        alpha * (alpha - 2) / (a[3] * a[5]),
    ]
    expected = [math.sqrt((2 * l + 1) / (4 * math.pi)) * r for l, r in enumerate(rho)]
    assert_close(zh.phong_zh(tensor(alpha), order=5), expected, ulps=TIGHT)


def test_lobe_is_the_zonal_function_about_its_axis(rng):
    z, axis, s = (tensor(x) for x in (rng.normal(size=(6, 7)), unit(rng, 6), unit(rng, 6)))
    assert_close(sh.sh_evaluate(zh.zh_to_sh(z, axis), s), zh.zh_evaluate(z, axis, s), ulps=TIGHT)
    opposite = zh.zh_to_sh(z * tensor([(-1.0) ** l for l in range(7)]), -axis)
    assert_close(opposite, zh.zh_to_sh(z, axis), ulps=TIGHT)


def test_convolution_with_the_clamped_cosine_gives_irradiance(rng):
    f = tensor(rng.normal(size=16))
    kernel = tensor(oracles.zonal_coefficients(lambda x: x, 4, 0.0, 1.0))
    factors = np.repeat([math.pi, 2 * math.pi / 3, math.pi / 4, 0.0], [1, 3, 5, 7])
    assert_close(sh.sh_convolve_zonal(f, kernel), f.numpy() * factors, ulps=TIGHT)


# --- the BRDF operator
# -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", sorted(oracles.PHONG_TABLE))
def test_phong_operator_reproduces_the_printed_table(alpha):
    m = brdf_operator.phong_operator(tensor(alpha)).numpy()
    for entry, value in oracles.PHONG_TABLE[alpha].items():
        i, j = int(entry[0], 16), int(entry[1], 16)
        assert m[i, j] == pytest.approx(value, abs=5.1e-8), entry  # seven decimals were printed
    assert_close(m, m.T, ulps=8.0)


@pytest.mark.parametrize("alpha", [0.0, 0.37, 1.0, 2.5, 20.0, 1000.0])
def test_phong_operator_is_the_corrected_appendix(alpha):
    m, forms = brdf_operator.phong_operator(tensor(alpha)).numpy(), oracles.phong_closed_forms(alpha)
    assert len(forms) == 20
    for entry, value in forms.items():
        np.testing.assert_allclose(m[int(entry[0], 16), int(entry[1], 16)], value, rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize(("alpha", "nonzeros"), [(0.0, 36), (1.0, 42), (2.5, 44)])
def test_phong_operator_is_as_sparse_as_stated(alpha, nonzeros):
    m = brdf_operator.phong_operator(tensor(alpha)).numpy()
    assert (np.abs(m) > 1e-14).sum() == nonzeros


@pytest.mark.parametrize("order", [1, 4, 10])
def test_phong_operator_is_exact_at_any_order_and_exponent(order):
    for alpha in (0.0, 0.375, 1.0, 200.5, 1000.0):
        got = brdf_operator.phong_operator(tensor(alpha), order=order).numpy()
        expected = oracles.phong_matrix(alpha, order)
        # The eigenvalues behind the nodes carry a few eps; powers up to sin^18 of them multiply that by 18.
        bound = 1e-11 * np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert (np.abs(got - expected) <= bound).all(), (alpha, (np.abs(got - expected) / bound).max())


def test_oracles_of_the_operator_agree():
    for alpha in (0.37, 3.7):
        brute = oracles.operator_matrix(lambda x, a=alpha: x**a, 4)
        assert_close(brute, oracles.phong_matrix(alpha, 4), ulps=TIGHT)
        assert_close(brdf_operator.phong_operator(tensor(alpha)), brute, ulps=TIGHT)


def test_phong_operator_steps_up_by_the_cosine_recurrence():
    """M^(α+1)[l, l'] = A(l+1, m) M^α[l+1, l'] + A(l, m) M^α[l-1, l'] with A = √((l²-m²)/(4l²-1))."""
    order, alpha = 6, 2.7
    low, high = (brdf_operator.phong_operator(tensor(a), order=order).numpy() for a in (alpha, alpha + 1))
    for l in range(order - 1):
        for m in range(-l, l + 1):
            row = math.sqrt(((l + 1) ** 2 - m * m) / (4 * (l + 1) ** 2 - 1)) * low[(l + 1) * (l + 2) + m]
            if l > abs(m):
                row = row + math.sqrt((l * l - m * m) / (4 * l * l - 1)) * low[l * (l - 1) + m]
            assert_close(high[l * (l + 1) + m], row, ulps=TIGHT)


def test_phong_operator_differentiates_in_the_exponent():
    h = 1e-4
    for alpha in (0.01, 0.37, 1.0, 60.0):
        slope = torch.func.jacrev(lambda a: brdf_operator.phong_operator(a, order=4))(tensor(alpha))
        above, below = (oracles.phong_matrix(alpha + d, 4) for d in (h, -h))
        # Central differences: h²/6 times the third derivative, which is at most 6 here, plus eps/h.
        np.testing.assert_allclose(slope, (above - below) / (2 * h), atol=2e-8)


def test_phong_operator_is_not_the_truncated_product(rng):
    """M¹ uses the whole lobe; the product with one cut at order 4 differs by up to 0.027, at (2, C)."""
    lobe = np.zeros(16)
    lobe[[0, 2, 6, 12]] = oracles.zonal_coefficients(lambda x: x, 4, 0.0, 1.0)
    truncated = np.einsum("ijk,i->jk", oracles.triple_products(4), lobe)
    gap = np.abs(brdf_operator.phong_operator(tensor(1.0)).numpy() - truncated)
    assert np.unravel_index(gap.argmax(), gap.shape) in ((2, 12), (12, 2))
    assert gap.max() == pytest.approx(0.027, abs=5e-4)


def test_brdf_operator_of_a_phong_kernel(rng):
    def kernel(x: Tensor) -> Tensor:
        return 0.25 * x**3 + x

    expected = 0.25 * oracles.phong_matrix(3.0, 4) + oracles.phong_matrix(1.0, 4)
    assert_close(brdf_operator.brdf_operator(kernel), expected, ulps=8, dtype=np.float32)


def test_unshadowed_visibility_becomes_the_clamped_cosine():
    """M¹ of the constant 1 is the clamped cosine, to every band, although M¹ is cut at order 4."""
    one = tensor([math.sqrt(4 * math.pi)] + [0.0] * 15)
    got = brdf_operator.apply_operator(brdf_operator.phong_operator(tensor(1.0)), one)
    cosine = oracles.zonal_coefficients(lambda x: x, 4, 0.0, 1.0)
    assert_close(got, zh.zh_to_sh(tensor(cosine), tensor([0.0, 0.0, 1.0])), ulps=TIGHT)


# --- light
# -----------------------------------------------------------------------------------------------------


def test_environment_is_read_with_its_orientation(rng):
    """A map of f(direction) has the SH of f; which way is up, ahead and right is part of f."""
    c = rng.normal(size=9)
    directions, solid_angle = latlong.environment_directions(64, 128)
    assert solid_angle.sum() == pytest.approx(4 * math.pi, rel=1e-14)
    image = sh.sh_evaluate(tensor(c), directions)[..., None].expand(-1, -1, 3)
    # Exact solid angles at row centres: the error is that of the midpoint rule, (π/64)² / 24 per unit
    # curvature, times l(l+1) <= 6 and a few.
    assert np.abs(light.project_environment(image, order=3).numpy() - c).max() < 5e-3
    assert directions[0, 0, 1] > 0.99  # row 0 is the zenith
    assert directions[32, 64, 2] < -0.99  # the middle looks down -Z
    assert directions[32, 96, 0] > 0.99  # columns turn towards +X


def test_environment_turned_about_y(rng):
    image = tensor(rng.random((6, 12, 2)))
    turned = light.project_environment(light.rotate_environment(image, math.pi / 3), order=4)
    c, s = math.cos(math.pi / 3), math.sin(math.pi / 3)
    about_y = tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    assert_close(turned, sh.sh_rotate(light.project_environment(image, order=4), about_y), ulps=TIGHT)


@pytest.mark.parametrize("radius", [0.3, 1.2, math.pi])
def test_area_light_is_a_cap(rng, radius):
    direction, radiance = unit(rng), np.array([1.0, 2.0, 0.5])
    cap = oracles.zonal_coefficients(np.ones_like, 5, math.cos(radius), 1.0)
    expected = radiance[:, None] * zh.zh_to_sh(tensor(cap), tensor(direction)).numpy()
    got = light.sh_area_light(tensor(direction), tensor(radius), tensor(radiance), order=5)
    assert_close(got, expected, ulps=TIGHT)


def test_small_area_light_tends_to_a_directional_one(rng):
    direction, one = tensor(unit(rng)), tensor([1.0])
    radius = 1e-8
    small = light.sh_area_light(direction, tensor(radius), one, order=5) / (math.pi * radius**2)
    # Relative deviation of band l: l(l+1) r²/8, below eps here.
    assert_close(small, light.sh_directional_light(direction, one, order=5), ulps=TIGHT)


def test_window_is_the_raised_cosine():
    gains = light.sh_window(torch.ones(25, dtype=torch.float64), width=4.0)[[0, 2, 6, 12, 20]]
    assert_close(gains, [1.0, (1 + math.sqrt(0.5)) / 2, 0.5, (1 - math.sqrt(0.5)) / 2, 0.0], ulps=TIGHT)


# --- lobe fit
# --------------------------------------------------------------------------------------------------


def test_charts_come_back_and_measure_angles(rng):
    axis, reference = tensor(unit(rng, 20)), tensor(rotations(rng, 20))
    chart = zh_fit.chart_from_axis(axis, reference)
    assert_close(zh_fit.axis_from_chart(chart, reference), axis, ulps=1e6)  # cond. |chart|²
    tilted = zh_fit.axis_from_chart(tensor([0.01, 0.0]), torch.eye(3, dtype=torch.float64))
    assert math.asin(tilted[0]) == pytest.approx(0.01, rel=1e-5)


def test_linear_direction_is_the_axis_of_a_band_1_lobe(rng):
    axis = tensor(unit(rng, 5))
    v = zh.zh_to_sh(tensor([0.3, 1.0, 0.0, 0.0]).expand(5, 4), axis)
    assert_close(zh_fit.optimal_linear_direction(v), axis, ulps=TIGHT)


def test_single_lobe_has_the_closed_form(rng):
    """z_l = √(4π/(2l+1)) Σ_m y_lm(d) v_lm and residual |v|² - Σ z_l²."""
    v, axis = tensor(rng.normal(size=(4, 16))), tensor(unit(rng, 4))
    z, residual = zh_fit.solve_lobe_coefficients(v, axis[:, None], order=4)
    y = oracles.real_harmonics(axis.numpy(), 4) * v.numpy()
    expected = np.stack(
        [math.sqrt(4 * math.pi / (2 * l + 1)) * y[:, l * l : (l + 1) ** 2].sum(-1) for l in range(4)], -1
    )
    assert_close(z[:, 0], expected, ulps=TIGHT)
    assert_close(residual, (v.numpy() ** 2).sum(-1) - (expected**2).sum(-1), ulps=TIGHT)


@pytest.mark.parametrize("num_lobes", [1, 2, 3])
def test_lobe_fit_finds_what_lobes_made(rng, num_lobes):
    z = tensor(rng.normal(size=(4, num_lobes, 4)))
    v = zh.lobes_to_sh(z, tensor(unit(rng, 4, num_lobes)))
    fit = zh_fit.fit_zh_lobes(v, num_lobes=num_lobes, order=4, num_starts=8, num_steps=60)
    # Least squares stops where the error is the square of the Jacobian's: 1e-10 relative, 1e-20 squared.
    assert (fit.residual < 1e-18 * (v**2).sum(-1)).all()
    assert_close(zh.lobes_to_sh(fit.coefficients, fit.axes), v, ulps=1e7)


def test_lobe_fit_splits_band_0_evenly(rng):
    fit = zh_fit.fit_zh_lobes(tensor(rng.normal(size=16)), num_lobes=3, order=4)
    assert_close(fit.coefficients[:, 0], fit.coefficients[:, 0].mean().expand(3), ulps=TIGHT)


def test_anchored_fit_stays_at_heavy_anchors(rng):
    v, anchors = tensor(rng.normal(size=(3, 16))), tensor(unit(rng, 3, 2))
    held = zh_fit.fit_zh_lobes(v, num_lobes=2, order=4, anchor_axes=anchors, anchor=1e9)
    assert_close(held.axes, anchors, ulps=1e9)  # moved by about |gradient| / anchor
    assert held.coefficients.abs().max() < 1e-5
    free = zh_fit.fit_zh_lobes(v, num_lobes=2, order=4, anchor_axes=anchors, anchor=1e-3, num_steps=40)
    fixed = zh_fit.solve_lobe_coefficients(v, anchors, order=4)[1]
    assert (free.residual < fixed).all()


def test_shared_axes_serve_all_vectors(rng):
    axes, z = tensor(unit(rng, 2, 1, 2)), tensor(rng.normal(size=(2, 5, 2, 4)))
    v = zh.lobes_to_sh(z, axes)
    shared = zh_fit.fit_shared_axes(v, num_lobes=2, order=4, num_starts=8, num_steps=40)
    residual = zh_fit.solve_lobe_coefficients(v, shared[:, None], order=4)[1]
    assert (residual < 1e-18 * (v**2).sum(-1)).all()


# --- linear model
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(40, 7), (6, 11)])
@pytest.mark.parametrize("ridge", [0.0, 1e-2])
def test_linear_fit_solves_the_normal_equations(rng, shape, ridge):
    a, b = rng.normal(size=shape) + 3.0, rng.normal(size=(shape[0], 4)) - 1.0
    fit = linear_model.fit_linear(tensor(a), tensor(b), ridge=ridge)
    ac, bc = a - a.mean(0), b - b.mean(0)
    x = fit.weights.numpy()
    # A weight w costs (w σ)², and σ² summed over frames and meaned over columns of unit σ is their number.
    penalty = ridge * len(a) * a.var(0)[:, None]
    gradient = ac.T @ (ac @ x - bc) + penalty * x
    assert np.abs(gradient).max() < 1e-12 * np.abs(ac.T @ bc).max()
    assert int(fit.rank) == min(shape[0] - 1, shape[1])
    left = np.linalg.norm(bc - ac @ x) / np.linalg.norm(bc)
    assert fit.residual.item() == pytest.approx(left, abs=1e-12)
    assert_close(linear_model.predict_linear(fit, tensor(a)), ac @ x + b.mean(0), ulps=TIGHT)


def test_linear_fit_sees_the_rank(rng):
    a = rng.normal(size=(20, 2)) @ rng.normal(size=(2, 6))
    fit = linear_model.fit_linear(tensor(a), tensor(a @ rng.normal(size=(6, 3))), ridge=0.0)
    assert int(fit.rank) == 2
    assert fit.residual < 1e-13


# --- shading
# ---------------------------------------------------------------------------------------------------


def scene(rng, n=5, lobes=2):
    return dict(
        axes=tensor(unit(rng, n, lobes)),
        coefficients=tensor(rng.normal(size=(n, lobes, 4))),
        frames=tensor(rotations(rng, n)),
        light=tensor(rng.normal(size=(3, 16))),
        albedo=tensor(rng.random((n, 3))),
    )


@pytest.mark.parametrize("alpha", [1.0, 12.5])
def test_relight_is_the_integral_over_the_lobe(rng, alpha):
    """(α+1)/2π ∫ V(s) L(s) max(0, r·s)^α ds with V and L of order 4, where the operator's truncation costs
    nothing.

    For V·(lobe) only bands below 4 meet L, and M^α holds these exactly, so brute force must agree.
    """
    s = scene(rng)
    positions, eye = tensor(rng.normal(size=(5, 3))), tensor([0.0, 1.0, 6.0])
    got = relight.relight(**s, positions=positions, exponent=tensor(alpha), eye=eye)
    t, w = np.polynomial.legendre.leggauss(60)
    t, w = (1 + t) / 2, w / 2
    local, weights = oracles.product_rule(t**2, w * 2 * t, 24)
    for v in range(5):
        n = s["frames"][v, :, 2].numpy()
        wo = eye.numpy() - positions[v].numpy()
        wo /= np.linalg.norm(wo)
        r = 2 * (n @ wo) * n - wo
        x = np.cross(r, [0.3, 0.5, -0.8])
        x /= np.linalg.norm(x)
        world = local @ np.stack([x, np.cross(r, x), r])
        vis = sh.sh_evaluate(zh.lobes_to_sh(s["coefficients"][v], s["axes"][v]), tensor(world @ s["frames"][v].numpy()))
        radiance = oracles.real_harmonics(world, 4) @ s["light"].numpy().T
        lobe = (alpha + 1) / (2 * np.pi) * local[:, 2] ** alpha
        expected = s["albedo"][v].numpy() * ((weights * lobe * vis.numpy()) @ radiance)
        # 60 nodes in t with cos θ = t² are exact for t^25·t^(odd polynomial) of degree < 120.
        assert_close(got[v], expected, ulps=TIGHT)


def test_diffuse_is_phong_seen_from_above(rng):
    """From straight above the mirror direction is the normal, and exponent 1 is Lambert's kernel."""
    s = scene(rng)
    n = s["frames"][..., 2]
    for v in range(5):
        one = {k: (x if k == "light" else x[v : v + 1]) for k, x in s.items()}
        phong = relight.relight(**one, positions=-3.0 * n[v : v + 1], exponent=tensor(1.0), eye=2.0 * n[v])
        assert_close(relight.relight_diffuse(**one), phong, ulps=TIGHT)


def test_membrane_adds_the_back_lobe(rng):
    """s_z/π in front, τ |s_z|/π behind; with full visibility t_l = A_l/π (1 + (-1)^l τ) y_l(n)."""
    a = np.array([1.0, 2.0 / 3.0, 0.25, 0.0])
    tau = np.array([0.2, 0.7])
    one = tensor([math.sqrt(4 * math.pi)] + [0.0] * 15)
    got = membrane.membrane_transfer(one, tensor(tau))
    signs = np.array([1.0, -1.0, 1.0, -1.0])
    expected = np.zeros((2, 16))
    scale = a * np.sqrt((2 * np.arange(4) + 1) / (4 * np.pi))
    expected[:, [0, 2, 6, 12]] = scale * (1.0 + signs * tau[:, None])
    assert_close(got, expected, ulps=TIGHT)
    s = scene(rng)
    front = relight.relight_diffuse(**s)
    assert_close(relight.membrane(**s, transmission=torch.zeros(3).double()), front, ulps=TIGHT)
    back = relight.membrane(**s, transmission=torch.ones(3).double()) - front
    mirrored = relight.relight_diffuse(
        axes=tensor([[[0.0, 0, 1]]] * 5),
        coefficients=tensor([[[math.sqrt(4 * math.pi), 0, 0, 0]]] * 5),
        frames=s["frames"] @ torch.diag(tensor([1.0, -1, -1])),
        light=s["light"],
        albedo=s["albedo"],
    )
    assert_close(back, mirrored, ulps=TIGHT)


# --- visibility
# ------------------------------------------------------------------------------------------------


def test_visibility_under_a_roof():
    """A large square above hides all but the directions that pass its edge."""
    positions = tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1.0]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    directions = visibility.hemisphere_directions(64)
    frames = torch.eye(3, dtype=torch.float64).expand(7, 3, 3)
    bits = visibility.trace_visibility(positions, frames, faces, directions, points=torch.tensor([0]))
    seen = visibility.unpack_visibility(bits, num_directions=64)[0].numpy()
    hit = np.abs(directions.numpy()[:, :2] / directions.numpy()[:, 2:]).max(-1)
    # The ray starts 1e-4 of the diagonal, which is 3, above the floor.
    assert (seen == (hit * (1.0 - 3e-4) > 1.0)).all()
    assert (bits.numpy() == np.packbits(seen.astype(bool)[None], axis=-1)).all()
    table = visibility.projection_table(directions, order=4)
    assert_close(visibility.project_visibility(bits, table)[0], seen @ table.numpy(), ulps=TIGHT)


# --- animation
# -------------------------------------------------------------------------------------------------


def test_quaternions_compose_like_matrices(rng):
    a, b = (
        tensor(q / np.linalg.norm(q, axis=-1, keepdims=True))
        for q in (rng.normal(size=(8, 4)), rng.normal(size=(8, 4)))
    )
    product = skeleton.quaternion_to_matrix(skeleton.quaternion_multiply(a, b))
    assert_close(product, skeleton.quaternion_to_matrix(a) @ skeleton.quaternion_to_matrix(b), ulps=TIGHT)
    inverse = skeleton.quaternion_to_matrix(skeleton.quaternion_conjugate(a))
    assert_close(inverse, skeleton.quaternion_to_matrix(a).transpose(-1, -2), ulps=TIGHT)


def test_rotation_vectors_are_angle_times_axis():
    quarter = skeleton.rotation_vector_to_quaternion(tensor([0.0, 0.0, math.pi / 2]))
    turned = skeleton.quaternion_to_matrix(quarter) @ tensor([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turned, [0.0, 1.0, 0.0], atol=1e-15)
    for angle in (0.0, 1e-9, 1e-5, 0.3, 3.1, math.pi - 1e-9):
        r = angle * tensor([0.6, 0.0, -0.8])
        back = skeleton.quaternion_to_rotation_vector(skeleton.rotation_vector_to_quaternion(r))
        assert_close(back, r, ulps=TIGHT)


def test_slerp_is_the_sine_formula(rng):
    q = rng.normal(size=(2, 10, 4))
    a, b = q / np.linalg.norm(q, axis=-1, keepdims=True)
    t = rng.random((10, 1))
    cos = (a * b).sum(-1, keepdims=True)
    angle = np.arccos(np.abs(cos))
    expected = (np.sin(angle * (1 - t)) * a + np.sign(cos) * np.sin(angle * t) * b) / np.sin(angle)
    assert_close(skeleton.slerp(tensor(a), tensor(b), tensor(t)), expected, ulps=TIGHT)


def test_spline_is_the_hermite_formula(rng):
    v0, b0, v1, a1 = rng.normal(size=(4, 6, 3))
    t, td = rng.random((6, 1)), 0.7
    expected = (
        (2 * t**3 - 3 * t**2 + 1) * v0
        + td * (t**3 - 2 * t**2 + t) * b0
        + (-2 * t**3 + 3 * t**2) * v1
        + td * (t**3 - t**2) * a1
    )
    got = skeleton.cubic_spline(*(tensor(x) for x in (v0, b0, v1, a1, t)), span=tensor([[td]] * 6))
    assert_close(got, expected, ulps=TIGHT)


def test_normals_survive_shear_and_mirror(rng):
    linear = rng.normal(size=(6, 3, 3))
    n = unit(rng, 6)
    expected = np.einsum("vji,vj->vi", np.linalg.inv(linear), n)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert (np.linalg.det(linear) < 0).any()
    assert_close(skinning.transform_normals(tensor(linear), tensor(n)), expected, ulps=1e6)  # cond. of M


def test_tangent_is_the_published_one(rng):
    n = unit(rng, 30)
    x, y, z = n.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    expected = np.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], -1)
    assert_close(vecmath.orthonormal_tangent(tensor(n)), expected, ulps=TIGHT)


# --- camera, metrics, scene
# ------------------------------------------------------------------------------------------------------


def test_pixels_and_rays_are_inverse(rng):
    eye, target, up = (tensor(rng.normal(size=3)) for _ in range(3))
    view = camera.Camera(eye, target, up, tensor(0.9))
    origins, directions = camera.camera_rays(view, height=4, width=7)
    px, depth = camera.project_px(view, origins + 3.0 * directions, height=4, width=7)
    rows, columns = np.meshgrid(np.arange(4) + 0.5, np.arange(7) + 0.5, indexing="ij")
    assert_close(px, np.stack([columns, rows], axis=-1), ulps=TIGHT)
    # The top row's outer edge is half the field of view above the axis.
    edge = camera.camera_rays(view, height=4, width=7, offsets=tensor([0.5, 0.0]))[1][0, 3]
    assert math.acos((edge @ (target - eye)) / (target - eye).norm()) == pytest.approx(0.45, rel=1e-12)
    view_from_world = camera.view_from_world(view)
    ahead = tensor([0.0, 0.0, -(target - eye).norm().item(), 1.0])
    assert_close(view_from_world @ torch.cat([target, tensor([1.0])]), ahead, ulps=TIGHT)
    assert_close(view_from_world[:3, :3].T, camera.look_at(eye, target, up), ulps=TIGHT)
    assert (depth > 0).all()


def test_framed_box_touches_the_edge_of_the_picture():
    low, high = tensor([-0.4, 0.0, -1.5]), tensor([0.6, 1.8, 0.3])
    corners = tensor([[x, y, z] for x in (-0.4, 0.6) for y in (0.0, 1.8) for z in (-1.5, 0.3)])
    view = camera.frame_bounds(low, high, azimuth_radians=0.7, elevation_radians=0.4, aspect=1.5, margin=0.0)
    px, _ = camera.project_px(view, corners, height=100, width=150)
    assert torch.cat([px, tensor([150.0, 100.0]) - px], dim=-1).min().item() == pytest.approx(0.0, abs=1e-10)


def test_metrics_of_known_images(rng):
    image, reference = torch.full((12, 12, 1), 0.75).double(), torch.full((12, 12, 1), 0.25).double()
    assert metrics.mse(image, reference) == 0.25
    assert metrics.psnr(image, reference).item() == pytest.approx(10 * math.log10(4))
    assert metrics.relative_l2(image, reference).item() == pytest.approx(2.0)
    # Without variance only the luminance term is left, c1 = 1e-4.
    assert metrics.ssim(image, reference) == pytest.approx((2 * 3 / 16 + 1e-4) / (10 / 16 + 1e-4), rel=1e-12)
    noise = rng.random((12, 12, 1))
    assert metrics.ssim(noise, noise) == pytest.approx(1.0)
    assert_close(metrics.heatmap(tensor([0.0, 1.0, math.nan]), high=2.0)[2], [0.0, 1.0, 0.0], ulps=0)
    # The middle of the scale is (188, 55, 84) in sRGB.
    middle = [((c / 255 + 0.055) / 1.055) ** 2.4 for c in (188, 55, 84)]
    assert_close(metrics.heatmap(tensor([1.0]), high=2.0), tensor([middle]), ulps=TIGHT)


def test_normals_of_a_tetrahedron():
    """Three legs along the axes: the normals of its faces are -x, -y, -z of area 1/2, and (1, 1, 1)/2 of area √3/2."""
    vertices = tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    third = math.sqrt(1 / 3)
    # At the tips two legs' faces and the oblique one add up: (1, 1, 1) - (0, 1, 1) for the tip on x.
    expected = tensor([[-third, -third, -third], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert_close(vertex_normals(vertices, faces), expected, ulps=8)


def test_frames_of_a_sequence_turn_with_the_mesh(rng):
    vertices, faces = tensor(rng.normal(size=(4, 3))), torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    turn = tensor(rotations(rng, 2))
    moved = torch.einsum("fij,vj->fvi", turn, vertices)
    frames = make_mesh_sequence(moved, faces, tensor(np.zeros((2, 1)))).frames
    assert_close(frames[1], turn[1] @ turn[0].T @ frames[0], ulps=TIGHT)
