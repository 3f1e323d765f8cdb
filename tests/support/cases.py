"""One list of inputs for the twins: NumPy data, given to `jaxrender` and to `torchref` alike.

A case names its kernel without the package ("harmonics.sh.sh_basis"). Arrays are float64 and are rounded to
the dtype under test; records and options are built in either package from plain data.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from tests.support import scenes
from tests.support.tolerances import LONG_SUM, ROUNDING, TIGHT


@dataclass(frozen=True)
class Record:
    """A record of both packages, by its name without the package and its fields.

    A `host` record holds NumPy arrays in both packages (clips, skeletons: data of the program).
    """

    name: str
    fields: dict[str, Any]
    host: bool = False


def _whole(result: Any) -> Any:
    return result


def _up_to_sign(quaternions: Any) -> Any:
    """q and -q are one rotation: q times its own w."""
    return quaternions * quaternions[..., 3:]


def _pose_up_to_sign(pose: Any) -> tuple:
    return pose.translation, _up_to_sign(pose.rotation), pose.scale


def _second(result: Any) -> Any:
    return result[1]


def _residual_beside_1(fit: Any) -> tuple:
    """A linear fit whose relative residual is judged on its scale, 1 = no better than the mean."""
    return fit.weights, fit.bias, fit.rank, fit.residual + 1.0


@dataclass(frozen=True)
class Case:
    """One call, made by keywords, and how far its two results may lie apart (units: see tolerances.py).

    `gradients` names the arrays, and the records of arrays, whose derivatives are compared, in float64: that shows
    whether the formulas agree. Where an argument or a field ("light.direction") lives on a manifold (`on`: "sphere" for
    unit vectors and quaternions, "rotation" for matrices) only the tangential part counts: formulas may differ off it.
    """

    kernel: str
    arguments: dict[str, Any]
    label: str = ""
    gradients: tuple[str, ...] = ()
    on: dict[str, str] = field(default_factory=dict)
    ulps64: float = TIGHT
    ulps32: float = ROUNDING
    gradient_ulps: float = TIGHT
    known: tuple[str, ...] = ()  # arrays that jaxrender must see when it is traced: connectivity
    entrywise: bool = False  # each entry's own magnitude is the scale
    host: bool = False  # runs on NumPy in float64 only: tables and bakes
    outcome: Callable[[Any], Any] = _whole  # what of the result is compared

    @property
    def id(self) -> str:
        return f"{self.kernel.split('.', 1)[-1]}[{self.label}]" if self.label else self.kernel.split(".", 1)[-1]


_rng = np.random.default_rng(4711)


def _normal(*shape: int) -> np.ndarray:
    return _rng.normal(size=shape)


def _uniform(low: float, high: float, *shape: int) -> np.ndarray:
    return _rng.uniform(low, high, size=shape)


def _unit(*shape: int, size: int = 3) -> np.ndarray:
    v = _rng.normal(size=(*shape, size))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _rotation(*shape: int) -> np.ndarray:
    q, _ = np.linalg.qr(_rng.normal(size=(*shape, 3, 3)))
    return q * np.linalg.det(q)[..., None, None]


def _spread_axes(n: int, num_lobes: int) -> np.ndarray:
    """n sets of unit axes whose Gram matrices P_l(d_i·d_j), l < 4, have no small eigenvalue but zeros."""
    sets = []
    while len(sets) < n:
        axes = _unit(num_lobes)
        smallest = min(
            np.linalg.eigvalsh(legendre.legval(axes @ axes.T, [0.0] * l + [1.0]))[-min(num_lobes, 2 * l + 1)]
            for l in range(4)
        )
        if smallest > 0.1:
            sets.append(axes)
    return np.stack(sets)


_POLES = np.concatenate([np.eye(3), -np.eye(3)])
_SPHERE = np.concatenate([_POLES, _unit(10)])


def _vecmath() -> list[Case]:
    zeros = np.zeros((1, 3))
    n = _unit(4)
    parallel = np.concatenate([_normal(2, 3), 2.0 * n[2:3], zeros])
    return [
        Case("vecmath.dot", {"a": _normal(4, 3), "b": _normal(1, 3)}, gradients=("a", "b")),
        Case("vecmath.safe_sqrt", {"x": np.array([-1.0, 0.0, 1e-20, 4.0])}, gradients=("x",)),
        Case(
            "vecmath.safe_div",
            {"a": np.array([1.0, 0.0, 2.0]), "b": np.array([0.0, 0.0, -4.0])},
            gradients=("a", "b"),
        ),
        Case("vecmath.normalize", {"v": np.concatenate([_normal(5, 3), zeros])}, gradients=("v",)),
        Case("vecmath.orthonormal_tangent", {"n": _SPHERE}, gradients=("n",), on={"n": "sphere"}),
        Case(
            "vecmath.frame_from_normal_tangent",
            {"normal": n, "tangent": parallel},
            gradients=("normal", "tangent"),
            on={"normal": "sphere"},
        ),
        Case(
            "vecmath.reflection_frame",
            {"wo": _unit(6), "n": _unit(6)},
            gradients=("wo", "n"),
            on={"wo": "sphere", "n": "sphere"},
        ),
    ]


def _sh() -> list[Case]:
    cases = [
        Case(
            "harmonics.sh.sh_basis",
            {"directions": _SPHERE, "order": order},
            f"order {order}",
            gradients=("directions",) if order < 10 else (),
            on={"directions": "sphere"},
        )
        for order in (1, 4, 10)
    ]
    cases += [
        Case(
            "harmonics.sh.sh_project",
            {"values": _normal(2, 9), "directions": _unit(9), "weights": _uniform(0, 1, 9), "order": 4},
            gradients=("values", "directions", "weights"),
            on={"directions": "sphere"},
        ),
        Case(
            "harmonics.sh.sh_evaluate",
            {"sh": _normal(5, 1, 16), "directions": _unit(5, 3)},
            gradients=("sh", "directions"),
            on={"directions": "sphere"},
        ),
        Case(
            "harmonics.sh.sh_product",
            {"a": _normal(3, 9), "b": _normal(1, 16)},
            "default order",
            gradients=("a", "b"),
        ),
        Case("harmonics.sh.sh_product", {"a": _normal(9), "b": _normal(16), "order": 6}, "whole product"),
        Case("harmonics.sh.sh_product", {"a": _normal(36), "b": _normal(36), "order": 6}, "order 6"),
        Case(
            "harmonics.sh.sh_convolve_zonal",
            {"sh": _normal(3, 25), "kernel": _normal(1, 5)},
            gradients=("sh", "kernel"),
        ),
    ]
    for order, lead in ((1, (2,)), (4, (3, 2)), (10, (2,))):
        rotation = _rotation(*lead)
        cases.append(
            Case(
                "harmonics.sh.sh_rotate",
                {"sh": _normal(*lead[:-1], 1, order**2), "rotation": rotation},
                f"order {order}",
                gradients=("sh", "rotation") if order < 10 else (),
                on={"rotation": "rotation"},
                # Table methods solve for lobes on fixed axes; the condition number of that grows with order.
                ulps32=LONG_SUM,
            )
        )
    for layout in ("gaussian_splatting", "e3nn", "scipy", "positive"):
        coefficients = _normal(2, 36)
        theirs = coefficients
        if layout == "scipy":  # that of a real function: c_l-m = (-1)^m conj c_lm
            theirs = np.zeros((2, 36), dtype=complex)
            for l in range(6):
                i = l * (l + 1)
                theirs[:, i] = coefficients[:, i]
                for m in range(1, l + 1):
                    theirs[:, i + m] = (coefficients[:, i + m] - 1j * coefficients[:, i - m]) / math.sqrt(2)
                    theirs[:, i - m] = (-1) ** m * theirs[:, i + m].conj()
        cases += [
            Case("harmonics.sh.sh_to_layout", {"sh": coefficients, "layout": layout}, layout, ulps32=LONG_SUM),
            Case("harmonics.sh.sh_from_layout", {"sh": theirs, "layout": layout}, layout, ulps32=LONG_SUM),
        ]
    return cases


def _zh() -> list[Case]:
    exponents = np.array([0.0, 0.37, 1.0, 2.0, 20.0, 1000.0])
    return [
        Case(
            "harmonics.zh.zh_to_sh",
            {"coefficients": _normal(6, 5), "axis": _unit(6)},
            gradients=("coefficients", "axis"),
            on={"axis": "sphere"},
        ),
        Case(
            "harmonics.zh.lobes_to_sh",
            {"coefficients": _normal(4, 2, 4), "axes": _unit(4, 2)},
            gradients=("coefficients", "axes"),
            on={"axes": "sphere"},
        ),
        Case("harmonics.zh.legendre", {"x": np.linspace(-1.0, 1.0, 9), "order": 10}, gradients=("x",)),
        Case(
            "harmonics.zh.zh_evaluate",
            {"coefficients": _normal(1, 5), "axis": _unit(6), "directions": _unit(6)},
            gradients=("coefficients", "axis", "directions"),
            on={"axis": "sphere", "directions": "sphere"},
        ),
        Case("harmonics.zh.clamped_cosine_zh", {"order": 10}),
        Case("harmonics.zh.hemisphere_zh", {"order": 10}),
        Case("harmonics.zh.phong_zh", {"exponent": exponents, "order": 4}, "order 4", gradients=("exponent",)),
        Case("harmonics.zh.phong_zh", {"exponent": exponents[1:], "order": 10}, "order 10", ulps32=LONG_SUM),
    ]


def _brdf_operator() -> list[Case]:
    return [
        # No exponent here makes an entry vanish, so each entry can be held to its own magnitude.
        Case(
            "harmonics.brdf_operator.phong_operator",
            {"exponent": np.array([[0.37, 2.5], [20.0, 1000.0]])},
            "entry by entry",
            gradients=("exponent",),
            entrywise=True,
        ),
        Case(
            "harmonics.brdf_operator.phong_operator",
            {"exponent": np.array([0.0, 1.0])},
            "vanishing entries",
            gradients=("exponent",),
        ),
        Case(
            "harmonics.brdf_operator.phong_operator",
            {"exponent": np.array([0.0, 1.0, 33.3, 1000.0]), "order": 10},
            "order 10",
            gradients=("exponent",),
        ),
        Case(
            "harmonics.brdf_operator.phong_normalization",
            {"exponent": _uniform(0, 9, 3)},
            gradients=("exponent",),
        ),
        Case(
            "harmonics.brdf_operator.brdf_operator",
            {"kernel": lambda x: 1.0 / (0.5 + x * x), "order": 5, "num_nodes": 48},
        ),
        Case(
            "harmonics.brdf_operator.apply_operator",
            {"operator": _normal(1, 9, 9), "sh": _normal(4, 9)},
            gradients=("operator", "sh"),
        ),
    ]


def _light() -> list[Case]:
    return [
        Case(
            "harmonics.light.project_environment",
            {"image": _uniform(0, 3, 8, 16, 3), "order": 5},
            gradients=("image",),
        ),
        Case(
            "harmonics.light.sh_directional_light",
            {"direction": _unit(4), "radiance": _uniform(0, 2, 1, 3), "order": 4},
            gradients=("direction", "radiance"),
            on={"direction": "sphere"},
        ),
        Case(
            "harmonics.light.sh_area_light",
            {
                "direction": _unit(4),
                "radius_radians": np.array([0.01, 0.3, 1.7, 3.0]),
                "radiance": _uniform(0, 2, 4, 3),
                "order": 6,
            },
            gradients=("direction", "radius_radians", "radiance"),
            on={"direction": "sphere"},
        ),
        Case(
            "harmonics.light.sh_area_light",
            {"direction": _unit(), "radius_radians": np.array(0.0047), "radiance": np.ones(3), "order": 6},
            "sun",
        ),
        Case("harmonics.light.sh_window", {"sh": _normal(3, 25), "width": 4.0}, gradients=("sh",)),
        *(
            Case(
                "harmonics.light.rotate_environment",
                {"image": _normal(3, 12, 2), "angle_radians": angle},
                f"{angle} rad",
            )
            for angle in (0.0, 0.7, -2.0, 9.0)
        ),
    ]


def _zh_fit() -> list[Case]:
    axis, reference = _unit(8), _rotation(8)
    cases = [
        Case(
            "harmonics.zh_fit.axis_from_chart",
            {"chart": np.concatenate([np.zeros((1, 2)), _normal(7, 2)]), "reference": reference},
            gradients=("chart", "reference"),
            on={"reference": "rotation"},
        ),
        Case(
            "harmonics.zh_fit.chart_from_axis",
            # Rounding of the axis is amplified by |chart|²/4 + 1 next to the far pole; the random axes here
            # stay within 20 of it.
            {"axis": axis, "reference": reference},
            gradients=("axis", "reference"),
            on={"axis": "sphere", "reference": "rotation"},
        ),
        Case("harmonics.zh_fit.reference_frames", {"axes": _SPHERE}),
        Case(
            "harmonics.zh_fit.optimal_linear_direction",
            {"sh": np.concatenate([_normal(4, 16), np.zeros((1, 16))])},
            gradients=("sh",),
        ),
    ]
    # jaxrender damps each band's solve by 1e-8 of its Gram matrix, the twin cuts singular values instead.
    # With no eigenvalue but zeros below 0.1 that moves z by at most 1e-6 relative; in float32, beside an
    # exact zero, the damping's root, 1e-4, leaves eps / 1e-4.
    name, axes = "harmonics.zh_fit.solve_lobe_coefficients", {c: _spread_axes(4, c) for c in (1, 2, 3, 4)}
    damped = {"ulps64": 4.5e9, "ulps32": 1e4, "gradient_ulps": 4.5e10}  # derivatives square the conditioning
    for label, lobes in (
        ("2 lobes", axes[2]),
        ("4 lobes", axes[4]),
        ("two on one axis", axes[2][:, [0, 0, 1]]),
    ):
        arguments = {"sh": _normal(4, 16), "axes": lobes, "order": 4}
        smooth = ("sh", "axes") if label == "2 lobes" else ()
        cases.append(Case(name, arguments, label, gradients=smooth, on={"axes": "sphere"}, **damped))
    # The residual feels the damping in second order only.
    for c in (1, 3):
        arguments = {"sh": _normal(4, 16), "axes": axes[c], "order": 4}
        cases.append(Case(name, arguments, f"residual of {c}", outcome=_second))
    return cases


def _linear_model() -> list[Case]:
    tall, wide = _normal(40, 6) + 2.0, _normal(7, 12) + 2.0
    units = np.array([1.0, 1e3, 1e-3, 1.0, 50.0, 1.0])
    constant = np.where(np.arange(6) == 3, 1e6 / 3.0, units * tall)
    fit = {"weights": _normal(6, 4), "bias": _normal(4), "rank": np.array(6), "residual": np.array(0.1)}
    return [
        *(
            Case(
                "harmonics.linear_model.fit_linear",
                {"features": a, "targets": _normal(len(a), 5), "ridge": ridge},
                f"{name}, ridge {ridge:g}",
                gradients=("features", "targets") if ridge else (),
                outcome=_residual_beside_1,
            )
            for name, a in (("tall", tall), ("wide", wide))
            for ridge in (0.0, 1e-2)
        ),
        Case(
            "harmonics.linear_model.fit_linear",
            {"features": units * tall, "targets": tall[:, :3] ** 2, "ridge": np.array(0.1)},
            "mixed units",
            gradients=("features", "targets", "ridge"),
            outcome=_residual_beside_1,
        ),
        Case(
            "harmonics.linear_model.fit_linear",
            {"features": constant, "targets": tall[:, :3] ** 2, "ridge": 0.1},
            "a constant column",
            outcome=_residual_beside_1,
        ),
        Case(
            "harmonics.linear_model.fit_linear",
            {"features": _normal(30, 2) @ _normal(2, 6), "targets": _normal(30, 3), "ridge": 0.0},
            "rank 2 of 6",
            outcome=_residual_beside_1,
        ),
        Case(
            "harmonics.linear_model.predict_linear",
            {"fit": Record("harmonics.linear_model.LinearFit", fit), "features": _normal(2, 3, 6)},
            gradients=("features",),
        ),
    ]


def _shading() -> list[Case]:
    v, m = 5, 2
    lobes = {"axes": _unit(v, m), "coefficients": _normal(v, m, 4), "frames": _rotation(v)}
    surface = {"light": _normal(3, 16), "albedo": _uniform(0, 1, v, 3)}
    view = {"positions": _normal(v, 3), "eye": np.array([0.3, 1.5, 6.0])}
    manifolds = {
        "axes": "sphere",
        "frames": "rotation",
        "world_from_local": "rotation",
        "rotation": "rotation",
    }
    shared = tuple(lobes) + tuple(surface)
    return [
        Case("harmonics.membrane.back_lobe", {}),
        Case(
            "harmonics.membrane.membrane_transfer",
            {"visibility": _normal(4, 16), "transmission": _uniform(0, 1, 4, 3)},
            gradients=("visibility", "transmission"),
        ),
        Case(
            "harmonics.relight.rotate_lobes",
            {"axes": lobes["axes"], "rotation": lobes["frames"]},
            gradients=("axes", "rotation"),
            on=manifolds,
        ),
        *(
            Case(
                "harmonics.relight.phong_transfer",
                {"visibility": _normal(v, 16), "exponent": exponent},
                f"exponent {exponent.shape}",
                gradients=("visibility", "exponent") if exponent.ndim else (),
            )
            for exponent in (np.array(12.5), _uniform(0, 90, v))
        ),
        Case(
            "harmonics.relight.shade_transfer",
            {"transfer": _normal(v, 16), "world_from_local": lobes["frames"], **surface},
            gradients=("transfer", "world_from_local", "light", "albedo"),
            on=manifolds,
        ),
        *(
            Case(
                "harmonics.relight.relight",
                {**lobes, **surface, **view, "exponent": exponent},
                f"exponent {exponent.shape}",
                gradients=(*shared, *view, "exponent") if exponent.ndim else (),
                on=manifolds,
            )
            for exponent in (np.array(1.0), _uniform(0, 90, v))
        ),
        Case("harmonics.relight.relight_diffuse", {**lobes, **surface}, gradients=shared, on=manifolds),
        *(
            Case(f"harmonics.relight.{name}", {**lobes, **surface, **more, "offset": _normal(v, 16)}, "offset")
            for name, more in (
                ("relight", {**view, "exponent": np.array(7.0)}),
                ("relight_diffuse", {}),
                ("membrane", {"transmission": _uniform(0, 1, 3)}),
            )
        ),
        *(
            Case(
                "harmonics.relight.membrane",
                {**lobes, **surface, "transmission": _uniform(0, 1, *shape)},
                f"transmission {shape}",
                gradients=(*shared, "transmission") if shape == (3,) else (),
                on=manifolds,
            )
            for shape in ((3,), (v, 3))
        ),
    ]


def _visibility() -> list[Case]:
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    box = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
         [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    turn = _rotation()
    positions = np.concatenate([corners, 0.4 * corners @ turn + [0.4, 2.1, 0.3]])
    normals = np.concatenate([corners, corners @ turn]) / math.sqrt(3.0)
    tangents = np.cross(normals, _unit(16))
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=-1)
    directions = _unit(40)
    directions[:, 2] = np.abs(directions[:, 2])
    bits = _rng.integers(0, 256, size=(3, 5), dtype=np.uint8)
    return [
        Case("harmonics.visibility.hemisphere_directions", {"num_directions": 50}, host=True),
        Case("harmonics.visibility.projection_table", {"directions": directions, "order": 4}, host=True),
        Case(
            "harmonics.visibility.trace_visibility",
            {
                "positions": positions,
                "frames": frames,
                "faces": np.concatenate([box, box + 8]).astype(np.int32),
                "directions": directions,
            },
            "two boxes",
            host=True,
        ),
        Case("harmonics.visibility.unpack_visibility", {"bits": bits, "num_directions": 37}),
        Case(
            "harmonics.visibility.project_visibility",
            {"bits": bits, "table": _normal(37, 9)},
            gradients=("table",),
        ),
    ]


_PARENTS = (-1, 0, 1, 1, -1, 4)


def _pose(*lead: int) -> Record:
    j = len(_PARENTS)
    return Record(
        "animation.skeleton.Pose",
        {
            "translation": _normal(*lead, j, 3),
            "rotation": _unit(*lead, j, size=4),
            "scale": _uniform(0.5, 1.5, *lead, j, 3),
        },
    )


def _skeleton() -> list[Case]:
    a, b = _unit(7, size=4), _unit(7, size=4)
    b[0], b[1] = a[0], -a[1]  # no turn at all, twice
    b[2] = a[2] + 1e-5 * _normal(4)
    b[2] /= np.linalg.norm(b[2])
    vectors = np.concatenate([np.zeros((1, 3)), 1e-9 * _unit(1), 1e-3 * _unit(1), 3.0 * _unit(2), _normal(3, 3)])
    half_angle = np.array([[0.0], [1e-8], [1e-3], [0.7], [1.5]])
    quaternions = np.concatenate([np.sin(half_angle) * _unit(5), np.cos(half_angle)], axis=-1)
    quaternions[3] = -quaternions[3]
    quaternion = {"a": "sphere", "b": "sphere", "q": "sphere"}
    key_times = np.array([0.1, 0.25, 0.7, 1.3])
    # Before, at, between and after the keys; derivatives are compared where they exist.
    times = np.array([-1.0, 0.1, 0.2, 0.5, 0.7, 1.1, 1.3, 2.0])
    keys = {
        ("STEP", False): _normal(4, 3),
        ("LINEAR", False): _normal(4, 3),
        ("LINEAR", True): _unit(4, size=4),
        ("CUBICSPLINE", False): _normal(4, 3, 3),
        ("CUBICSPLINE", True): np.stack([_normal(4, 4), _unit(4, size=4), _normal(4, 4)], axis=1),
    }
    return [
        Case(
            "animation.skeleton.quaternion_multiply",
            {"a": a, "b": b[:1]},
            gradients=("a", "b"),
        ),
        Case("animation.skeleton.quaternion_conjugate", {"q": a}, gradients=("q",)),
        Case("animation.skeleton.quaternion_to_matrix", {"q": a}, gradients=("q",), on=quaternion),
        Case(
            "animation.skeleton.rotation_vector_to_quaternion",
            {"rotation_vector": vectors},
            gradients=("rotation_vector",),
        ),
        Case(
            "animation.skeleton.quaternion_to_rotation_vector",
            {"q": quaternions},
            gradients=("q",),
            on=quaternion,
        ),
        Case(
            "animation.skeleton.slerp",
            {"a": a, "b": b, "t": _uniform(0, 1, 7, 1)},
            gradients=("a", "b", "t"),
            on=quaternion,
        ),
        Case(
            "animation.skeleton.cubic_spline",
            {
                "start": _normal(5, 3),
                "out_tangent": _normal(5, 3),
                "end": _normal(5, 3),
                "in_tangent": _normal(5, 3),
                "t": _uniform(0, 1, 5, 1),
                "span": _uniform(0.1, 2, 5, 1),
            },
            gradients=("start", "out_tangent", "end", "in_tangent", "t", "span"),
        ),
        *(
            Case(
                "animation.skeleton.sample_keys",
                {
                    "key_times": key_times,
                    "values": values,
                    "times": times,
                    "interpolation": interpolation,
                    "rotation": rotation,
                },
                f"{interpolation}{', rotation' if rotation else ''}",
                gradients=() if rotation else ("values",),
                outcome=_up_to_sign if rotation else _whole,
            )
            for (interpolation, rotation), values in keys.items()
        ),
        Case(
            "animation.skeleton.sample_keys",
            {
                "key_times": key_times,
                "values": keys["LINEAR", True],
                "times": np.array([0.2, 0.5, 1.1]),
                "interpolation": "LINEAR",
                "rotation": True,
            },
            "between the keys",
            gradients=("times",),
            outcome=_up_to_sign,
        ),
        Case(
            "animation.skeleton.sample_clip",
            {"clip": _clip(key_times, keys), "skeleton": _skeleton_record(), "times": times},
            outcome=_pose_up_to_sign,
        ),
        Case("animation.skeleton.local_matrices", {"pose": _pose(2)}),
        Case("animation.skeleton.global_matrices", {"pose": _pose(2), "parents": _PARENTS}),
    ]


def _skeleton_record() -> Record:
    names = tuple(f"joint {i}" for i in range(len(_PARENTS)))
    fields = {"names": names, "parents": _PARENTS, "rest": _pose()}
    return Record("animation.skeleton.Skeleton", fields)


def _clip(key_times: np.ndarray, keys: dict) -> Record:
    moves = [
        (1, "rotation", "LINEAR", keys["LINEAR", True]),
        (2, "translation", "LINEAR", keys["LINEAR", False]),
        (2, "rotation", "CUBICSPLINE", keys["CUBICSPLINE", True]),
        (4, "scale", "STEP", keys["STEP", False]),
        (5, "translation", "CUBICSPLINE", keys["CUBICSPLINE", False]),
    ]
    channels = tuple(
        Record(
            "animation.skeleton.Channel",
            {"joint": j, "path": p, "interpolation": i, "times": key_times, "values": v},
            host=True,
        )
        for j, p, i, v in moves
    )
    fields = {"name": "test", "channels": channels, "start": 0.0, "duration": 1.3}
    return Record("animation.skeleton.Clip", fields, host=True)


def _pose_model_record() -> Record:
    g, i, k, p, c = 2, 3, 4, 6, 2
    n = 13 * i
    basis = {
        "kind": "surroundings",
        "size": 1.75,
        "joints": np.array([0, 2, 5], dtype=np.int32),
        "bones": np.array([1, 4], dtype=np.int32),
        "falloff": _uniform(0, 1, g, i),
        "reference": _unit(i, size=4),
        "translations": _normal(i, 3),
        "mean": _normal(g, n),
        "basis": _normal(g, n, k),
    }
    model = {
        "features": Record("harmonics.pose_model.FeatureBasis", basis),
        "weights": 0.3 * _normal(k + 1, 6 * c, p),
        "axes": _unit(p, c),
        "offset": _normal(p, 16),
        "groups": np.array([0, 1, 1, 0, 0, 1], dtype=np.int32),
        "points": np.array([5, 4, 3, 2, 1, 0, 0], dtype=np.int32),
        "visible": np.array([True, True, False, True, True, True]),
    }
    return Record("harmonics.pose_model.PoseModel", model)


POSE_MODEL = _pose_model_record()


def _pose_model() -> list[Case]:
    basis = POSE_MODEL.fields["features"]
    fields = basis.fields
    angles = Record(basis.name, {**fields, "kind": "exponential_map"})
    matrices = np.tile(np.eye(4), (2, len(_PARENTS), 1, 1))
    matrices[..., :3, :] = _normal(2, len(_PARENTS), 3, 4)
    seen = {name: fields[name] for name in ("bones", "joints", "falloff", "size")}
    turned = {name: fields[name] for name in ("joints", "reference", "translations", "size")}
    room = "harmonics.pose_model"
    components = _normal(2, 4)
    return [
        Case(f"{room}.surroundings", {"globals": matrices[0], **seen}, gradients=("globals",)),
        Case(f"{room}.surroundings", {"globals": matrices, **seen}, "leading axes"),
        *(
            Case(f"{room}.joint_angles", {"pose": _pose(2), **turned, "euler": euler}, f"euler {euler}")
            for euler in (False, True)
        ),
        *(
            Case(
                f"{room}.raw_features",
                {"basis": b, "pose": _pose(), "globals": matrices[0]},
                b.fields["kind"],
            )
            for b in (basis, angles)
        ),
        Case(f"{room}.project_features", {"basis": basis, "raw": _normal(3, 2, 39)}, gradients=("raw",)),
        Case(f"{room}.predict_numbers", {"model": POSE_MODEL, "components": components}),
        Case(
            f"{room}.lobes_from_numbers",
            {"numbers": _normal(5, 12), "axes": _unit(5, 2)},
            gradients=("numbers",),
        ),
        Case(
            f"{room}.predict_lobes",
            {"model": POSE_MODEL, "components": components},
            gradients=("components",),
        ),
    ]


def _skin_and_globals() -> tuple[Record, np.ndarray]:
    v, k, p, j = 6, 3, 4, 5
    weights = _uniform(0, 1, v, k)
    weights[0] = [1, 0, 0]
    inverse_binds, matrices = (np.tile(np.eye(4), (*lead, 1, 1)) for lead in ((p,), (2, j)))
    inverse_binds[..., :3, :], matrices[..., :3, :] = _normal(p, 3, 4), _normal(2, j, 3, 4)
    skin = Record(
        "animation.skinning.Skin",
        {
            "vertices": _normal(v, 3),
            "normals": _unit(v),
            "joint_indices": _rng.integers(0, p, size=(v, k)).astype(np.int32),
            "weights": weights / weights.sum(-1, keepdims=True),
            "palette_joints": _rng.integers(0, j, size=p).astype(np.int32),
            "inverse_binds": inverse_binds,
        },
    )
    return skin, matrices


def _skinning() -> list[Case]:
    skin, matrices = _skin_and_globals()
    linear = _normal(7, 3, 3)
    linear[0] = np.diag([2.0, 1.0, -1.0])
    linear[1] = np.diag([1.0, 1.0, 0.0])
    return [
        Case(
            "animation.skinning.skinning_matrices",
            {"skin": skin, "globals": matrices},
            gradients=("globals",),
        ),
        Case(
            "animation.skinning.transform_normals",
            {"linear": linear, "normals": _unit(7)},
            gradients=("linear", "normals"),
            on={"normals": "sphere"},
        ),
        Case(
            "animation.skinning.skin_mesh",
            {"skin": skin, "globals": matrices},
            gradients=("globals",),
        ),
    ]


def _textures() -> Record:
    """Layers of 7 x 5 and 4 x 8 texels (w x h) with all levels, wrapped in four ways."""
    layers = [[(7, 5), (3, 2), (1, 1), (1, 1)], [(4, 8), (2, 4), (1, 2), (1, 1)]]
    sizes = np.array(layers, dtype=np.int32)
    offset = np.array([[0, 35, 41, 41], [42, 74, 82, 84]], dtype=np.int32)
    fields = {
        "texels": _uniform(0, 1, 85, 4),
        "offset": offset,
        "width": sizes[..., 0].copy(),
        "height": sizes[..., 1].copy(),
        "num_levels": np.array([3, 4], dtype=np.int32),
        "wrap": np.array([[0, 2], [1, 0]], dtype=np.int32),
    }
    return Record("deferred.texture.Textures", fields)


def _axes_up_to_sign(axes: Any) -> tuple:
    major, minor, direction = axes
    return major, minor, direction[..., :, None] * direction[..., None, :]


def _texture() -> list[Case]:
    room, textures = "deferred.texture", _textures()
    layer = np.array([0, 1, 0, 1, 0, 1, 7, -3], dtype=np.int32)
    uv = 1.3 * _normal(8, 2)
    lookup = {"textures": textures, "layer": layer, "uv": uv}
    gradients = {"duv_dx": 0.3 * _normal(8, 2), "duv_dy": 0.1 * _normal(8, 2)}
    steps = {"duv_dx": 0.3 * _normal(8, 2), "duv_dy": 0.3 * _normal(8, 2)}
    # Nothing, thin, very thin, parallel, round, wide, absurd, infinite.
    hard = {
        "duv_dx": np.array([[0, 0], [1, 0], [0, 1], [0.3, 0.2], [0.1, 0], [9, 4], [1e30, -1e30], [np.inf, 0]]),
        "duv_dy": np.array([[0, 0], [0, 0.02], [0, 0], [0.6, 0.4], [0, 0.05], [-5, 8], [0, 1e-30], [0, -np.inf]]),
    }
    filtered = {"textures": textures, "uv": uv, "layer": layer}
    filters = (f"{room}.sample_texture_grad", f"{room}.sample_ewa")
    free = ("uv", "duv_dx", "duv_dy")
    y, x = np.mgrid[0:6, 0:8]
    plane = np.stack([x + 0.3 * y, y - 0.2 * x], axis=-1) / (12.0 + x + 2.0 * y)[..., None]
    plane[:, 4:, 0] -= 0.9
    plane[3, 2] += 5.0
    seams = np.where(x + y < 4, 0, np.where(x > 5, 2, 1)).astype(np.int32)
    seams[4:, :2] = -1
    bytes_and_light = (_rng.integers(0, 256, size=(6, 5, 4), dtype=np.uint8), _uniform(0, 3, 3, 4, 3))
    return [
        Case(f"{room}.mip_sizes", {"height": 5, "width": 37}, host=True),
        Case(f"{room}.mip_chain", {"image": _uniform(0, 2, 13, 6, 4)}, gradients=("image",)),
        *(
            Case(f"{room}.build_textures", {"images": bytes_and_light, "wrap": wrap, "srgb": srgb}, f"srgb {srgb}")
            for wrap, srgb in (("clamp", True), (("mirror", ("repeat", "clamp")), (False, True)))
        ),
        Case(
            f"{room}.sample_bilinear",
            {**lookup, "level": np.array([0, 0, 1, 1, 2, 2, 9, -1], dtype=np.int32)},
            gradients=("uv",),
        ),
        Case(
            f"{room}.sample_trilinear",
            {**lookup, "lod": np.array([0.3, 1.7, 1.25, 2.5, 5.0, -1.0, 0.5, 0.9])},
            gradients=("uv", "lod"),
        ),
        Case(f"{room}.texture_lod", {"textures": textures, "layer": layer, **steps}, gradients=free[1:]),
        Case(f"{room}.texture_lod", {"textures": textures, "layer": layer, **hard}, "hard"),
        Case(
            f"{room}.footprint_axes",
            {"dx": _normal(6, 2), "dy": _normal(6, 2)},
            gradients=("dx", "dy"),
            outcome=_axes_up_to_sign,
        ),
        *(Case(f, {**filtered, **gradients}, gradients=free, ulps32=LONG_SUM) for f in filters),
        Case(filters[0], {**filtered, **hard}, "hard", ulps32=LONG_SUM),
        Case(filters[1], {**filtered, **hard, "max_radius": 12}, "hard", ulps32=LONG_SUM),
        Case(f"{room}.texture_derivatives", {"uv": plane, "layer": seams}, gradients=("uv",)),
    ]


def _quads() -> list[Case]:
    room = "deferred.quads"
    ids = np.sort(_rng.integers(0, 9, 21)).astype(np.int32)
    mask = _rng.integers(0, 16, 21).astype(np.int32)
    row, column = (_rng.integers(0, n, 21).astype(np.int32) for n in (3, 4))
    pixels = np.array([0, 1, 1, 2, 3, 4, 9, 40, 400, 3000], np.int32)
    touched = np.array([0, 1, 1, 2, 1, 3, 5, 18, 130, 800], np.int32)
    values = _normal(5, 7, 2)
    return [
        *(
            Case(f"{room}.{name}", {"values": values, "fine": fine}, f"fine {fine}", gradients=("values",))
            for name in ("ddx", "ddy")
            for fine in (True, False)
        ),
        Case(f"{room}.num_pixels", {"mask": mask}),
        Case(f"{room}.quad_statistics", {"triangle_id": ids, "mask": mask, "num_triangles": 11}),
        Case(f"{room}.helper_share", {"pixels": pixels, "quads": touched}),
        Case(f"{room}.helper_share_by_size", {"pixels": pixels, "quads": touched, "num_sizes": 9}),
        Case(f"{room}.quad_overdraw", {"row": row, "column": column, "rows": 4, "columns": 4}),
    ]


def _counts_of_warps(packed: Any) -> tuple:
    return packed.quads, packed.pixels, packed.triangles


def _warps() -> list[Case]:
    room = "deferred.warps"
    ids = np.sort(_rng.integers(0, 9, 21)).astype(np.int32)
    mask = _rng.integers(0, 16, 21).astype(np.int32)
    row, column = (_rng.integers(0, n, 21).astype(np.int32) for n in (3, 6))
    trips = _uniform(0, 9, 5, 11)
    taken = _rng.random((5, 11)) < 0.4
    by_block = {"warp_size": 16, "order": "blocks"}
    return [
        Case(f"{room}.pack_quads", {"triangle_id": ids, "mask": mask}, outcome=_counts_of_warps),
        Case(f"{room}.screen_lanes", {"values": trips}),
        Case(f"{room}.screen_lanes", {"values": trips, **by_block}, "blocks"),
        Case(f"{room}.quad_lanes", {"values": trips, "row": row, "column": column, "warp_size": 64}),
        Case(f"{room}.covered_lanes", {"mask": mask}),
        Case(f"{room}.loop_cost", {"trip_counts": _uniform(0, 9, 3, 8), "covered": _rng.random((3, 8)) < 0.7}),
        Case(f"{room}.warp_cost", {"trip_counts": trips, **by_block}),
        Case(f"{room}.branch_cost", {"taken": taken, "then_cost": 2.5, "warp_size": 8}),
        Case(f"{room}.raster_owners", {"height": 7, "width": 9, "tile_size": 2}),
        Case(f"{room}.raster_balance", {"work": trips, "num_rasters": 2, "tile_size": 2}),
    ]


def _camera_record(eye: list, target: list, up: list) -> Record:
    vectors = {"eye": np.array(eye), "target": np.array(target), "up": np.array(up)}
    return Record("camera.Camera", {**vectors, "fov_y_radians": np.array(0.7)})


def _camera() -> list[Case]:
    eye, target, up = [1.2, 2.0, 3.1], [0.1, 0.9, -0.2], [0.2, 1.3, 0.1]
    camera = _camera_record(eye, target, up)
    size = {"height": 3, "width": 4}
    views = {
        "general": (eye, target, up),
        "straight down": ([0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        "straight up": ([0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 3.0, 0.0]),
        "eye at target": (eye, eye, up),
    }
    box = {"minimum": np.array([-0.4, 0.0, -1.5]), "maximum": np.array([0.6, 1.8, 0.3])}
    angles = {"azimuth_radians": np.array(0.7), "elevation_radians": np.array(-0.4)}
    # Beside and behind the eye too; the last one lies in its plane.
    points = np.concatenate([_normal(5, 3), np.array([np.array(eye) + np.cross(up, np.subtract(eye, target))])])
    planes = {"near": np.array(0.5), "far": np.array(40.0)}
    return [
        Case("camera.clip_from_world", {"camera": camera, **size, **planes}, gradients=("camera", "near", "far")),
        *(
            Case("camera.depth_range", {"camera": _camera_record(*views[name]), **box}, name, gradients=("minimum",))
            for name in ("general", "straight down")
        ),
        *(
            Case(
                "camera.look_at",
                {name: np.array(v) for name, v in zip(("eye", "target", "up"), vectors, strict=True)},
                label,
                gradients=("eye", "target", "up"),
            )
            for label, vectors in views.items()
        ),
        Case("camera.view_from_world", {"camera": camera}, gradients=("camera",)),
        Case("camera.camera_rays", {"camera": camera, **size}, "centres", gradients=("camera",)),
        *(
            Case(
                "camera.camera_rays",
                {"camera": camera, **size, "offsets": _uniform(0, 1, *shape)},
                f"offsets {shape}",
                gradients=("camera", "offsets"),
            )
            for shape in ((2,), (3, 4, 2))
        ),
        Case(
            "camera.project_px",
            {"camera": camera, "points": points[:-1], "height": 6, "width": 9},
            gradients=("camera", "points"),
        ),
        Case(
            "camera.project_px",
            {
                "camera": _camera_record([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
                "points": np.array([[1.0, 2.0, 5.0], [0.0, 0.0, 5.0]]),
                **size,
            },
            "in the plane of the eye",
            gradients=("points",),
        ),
        Case(
            "camera.frame_bounds",
            {**box, **angles, "aspect": 1.9, "fov_y_radians": 0.9},
            "wide",
            gradients=(*box, *angles),
        ),
        Case("camera.frame_bounds", {**box, **angles, "aspect": 0.5, "margin": 0.3}, "tall", gradients=tuple(box)),
        Case("camera.frame_bounds", {**box, "elevation_radians": math.pi / 2}, "from above"),
        Case("camera.frame_bounds", {"minimum": np.ones(3), "maximum": np.ones(3)}, "a point"),
    ]


def _metrics() -> list[Case]:
    image = _uniform(0, 1, 13, 16, 2)
    reference = np.clip(image + 0.1 * _normal(13, 16, 2), 0.0, 1.0)
    pair = {"image": image, "reference": reference}
    values = {"values": _normal(4, 5), "reference": _normal(4, 5)}
    zeros = np.zeros((4, 5))
    numbers = _uniform(-0.9, 1.9, 4, 5)
    return [
        Case("metrics.mse", pair, gradients=tuple(pair)),
        Case("metrics.psnr", {**pair, "peak": 2.0}, gradients=tuple(pair)),
        Case("metrics.psnr", {"image": image, "reference": image}, "equal"),
        Case("metrics.relative_l2", values, gradients=tuple(values)),
        Case("metrics.relative_l2", {"values": zeros, "reference": zeros}, "zeros", gradients=tuple(values)),
        Case("metrics.relative_l2", {**values, "values": values["reference"]}, "equal", gradients=tuple(values)),
        Case("metrics.ssim", pair, host=True),
        Case(
            "metrics.ssim",
            {"image": 9.0 * image[:11], "reference": 9.0 * reference[:11], "peak": 9.0},
            "peak 9",
            host=True,
        ),
        Case("metrics.heatmap", {"values": numbers, "low": -1.0, "high": 2.0}, "inside", gradients=("values",)),
        Case("metrics.heatmap", {"values": numbers, "low": -0.2, "high": 0.7}, "clamped", gradients=("values",)),
        Case("metrics.heatmap", {"values": np.where(numbers > 1.5, np.nan, numbers)}, "with NaN"),
        Case("metrics.heatmap", {"values": zeros}, "constant"),
    ]


def _scene() -> list[Case]:
    # A tetrahedron whose faces all turn outwards, and a vertex without faces.
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 2, 2]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    vertices = corners + 0.2 * _normal(3, 5, 3)
    strip = np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32)
    sequence = {"vertices": vertices, "features": _normal(3, 2)}
    return [
        *(
            Case("scene.vertex_normals", {"vertices": v, "faces": faces}, label, gradients=("vertices",))
            for label, v in (("one", vertices[0]), ("leading axes", vertices))
        ),
        *(
            Case(
                "scene.make_mesh_sequence",
                {**sequence, "faces": f},
                label,
                gradients=("vertices", "features"),
                known=("faces",),
            )
            for label, f in (("closed", faces), ("strip", strip))
        ),
    ]


# 1 - n·h² is held against α² in D, so each rounding of n·h counts 1/α² times there; α = roughness².
def _ulps_of_facets(roughness: float) -> float:
    return 8.0 / roughness**4


def _brdf() -> list[Case]:
    n = _unit(12)
    wi, wo = (_unit(12) + 1.2 * n for _ in range(2))
    wi, wo = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (wi, wo))
    wi[2], wo[5] = -wi[2], -wo[5]  # below the horizon
    vectors = {"wi": wi, "wo": wo, "n": n}
    sphere = dict.fromkeys(vectors, "sphere")
    mirror = 2.0 * np.sum(n * wo, axis=1, keepdims=True) * n - wo
    near_peak = mirror + 0.01 * _normal(12, 3)
    near_peak /= np.linalg.norm(near_peak, axis=1, keepdims=True)
    cosines = {name: np.sum(a * b, axis=1) for name, a, b in (("n_i", n, wi), ("n_o", n, wo), ("i_o", wi, wo))}
    base = {"base_color": _uniform(0, 1, 12, 3)}
    rough = {"roughness": _uniform(0.4, 1.0, 12, 1)}
    either = {"metallic": (np.arange(12) % 2.0)[:, None]}
    exponent = _uniform(0.5, 60.0, 12)
    facets = _ulps_of_facets(0.4)
    function = "brdf.metallic_roughness"
    return [
        Case("brdf.lambert", {"albedo": _uniform(0, 1, 4, 3)}, gradients=("albedo",)),
        Case(
            "brdf.phong",
            {**vectors, "specular": _uniform(0, 1, 12, 3), "exponent": exponent[:, None]},
            gradients=(*vectors, "specular", "exponent"),
            on=sphere,
            ulps32=LONG_SUM,  # an exponent of 60
        ),
        Case("brdf.phong_lobe", {**cosines, "exponent": exponent}, gradients=(*cosines, "exponent"), ulps32=LONG_SUM),
        Case(
            "brdf.ggx",
            {**cosines, "roughness": rough["roughness"][:, 0]},
            gradients=(*cosines, "roughness"),
            ulps32=facets,
        ),
        Case(
            "brdf.ggx",
            {**cosines, "roughness": rough["roughness"][:, 0], "sin2_h": _uniform(0, 1, 12)},
            "half vector given",
            gradients=(*cosines, "roughness", "sin2_h"),
            ulps32=facets,
        ),
        Case(
            function,
            {**vectors, **base, **either, **rough},
            "metals and dielectrics",
            gradients=(*vectors, "base_color", "roughness"),
            on=sphere,
            ulps32=facets,
        ),
        Case(
            function,
            {**vectors, **base, **rough, "metallic": _uniform(0.2, 0.8, 12, 1)},
            "half metals",
            gradients=("metallic", "base_color"),
            ulps32=facets,
        ),
        Case(
            function,
            {**vectors, "wi": near_peak, **base, **either, "roughness": np.full((12, 1), 0.1)},
            "near the peak",
            ulps64=_ulps_of_facets(0.1),
            ulps32=_ulps_of_facets(0.1),
        ),
        Case(
            function,
            {**vectors, **base, "metallic": np.ones((12, 1)), "roughness": _uniform(0.0, 0.03, 12, 1)},
            "mirrors off their peak",
            entrywise=True,
            ulps32=LONG_SUM,
        ),
    ]


def _records(**records: dict[str, np.ndarray]) -> dict[str, Record]:
    """Records of `tests.support.scenes` by the names of their arguments."""
    names = {"material": "scene.Material", "lights": "scene.Lights", "textures": "deferred.texture.Textures"}
    return {name: Record(names[name], fields) for name, fields in records.items()}


def _scene_record() -> Record:
    parts = _records(material=scenes.material(_rng), lights=scenes.lights())
    extra = {"cameras": (), "name": "small"}
    return Record("scene.Scene", {**scenes.scene(_rng), **parts, **extra})


def _whole_scene() -> list[Case]:
    scene = {"scene": _scene_record()}
    return [
        Case("scene.scene_bounds", scene, gradients=("scene",)),
        Case("scene.whole_scene_camera", {**scene, "aspect": 1.7, "azimuth_radians": -1.0}, gradients=("scene",)),
        Case("scene.inside_camera", {**scene, "fov_y_radians": 0.8}, gradients=("scene",)),
    ]


def _gbuffer_record(*shape: int) -> Record:
    """Samples of the materials of `scenes.material` here and there, a few of them empty."""
    ids = np.arange(math.prod(shape), dtype=np.int32).reshape(shape) % 6 - 1
    normal = _unit(*shape) * [0.5, 0.5, 0.5] + [0.0, 1.0, 0.3]
    bent = normal + 0.4 * _normal(*shape, 3)
    some = (ids >= 0)[..., None]
    fields = {
        "position": _uniform(-1.0, 1.0, *shape, 3),
        "normal": bent / np.linalg.norm(bent, axis=-1, keepdims=True),
        "geometric_normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "uv": 1.5 * _normal(*shape, 2),
        "duv_dx": 0.3 * _normal(*shape, 2),
        "duv_dy": 0.1 * _normal(*shape, 2),
        "color": _uniform(0.2, 1.0, *shape, 4),
    }
    fields = {name: np.where(some, values, 0.0) for name, values in fields.items()}
    ids = {"material_id": np.minimum(ids, 3), "triangle_id": ids}
    return Record("deferred.gbuffer.GBuffer", {**fields, "depth": np.where(some[..., 0], 2.0, 0.0), **ids})


def _surface_record(*shape: int, metallic: np.ndarray) -> Record:
    fields = {
        "base_color": _uniform(0.1, 1.0, *shape, 3),
        "alpha": _uniform(0.0, 1.0, *shape),
        "metallic": metallic,
        "roughness": _uniform(0.5, 1.0, *shape, 1),
        "emissive": _uniform(0.0, 0.2, *shape, 3),
        "occlusion": _uniform(0.0, 1.0, *shape, 1),
    }
    return Record("deferred.shade.Surface", fields)


def _one_light(index: int, **changed: np.ndarray) -> Record:
    """A light of `scenes.lights`, without its leading axis."""
    fields = {name: np.array(values[index]) for name, values in scenes.lights().items()}
    return Record("scene.Lights", fields | changed)


def _deferred_shading() -> list[Case]:
    room = "deferred.shade"
    position = {"position": _uniform(-1.0, 1.0, 4, 3)}
    kinds = {"sun": 0, "lamp with an end": 2, "spot": 3}
    finite = {"range": np.array(7.0)}
    # Lights that end far away: the slope in a range of inf is tests/deferred/test_shading_gradients.py's.
    lights = scenes.lights()
    lights["range"] = np.minimum(lights["range"], 50.0)
    shape = 2, 12
    gbuffer = {"gbuffer": _gbuffer_record(*shape)}
    either = np.arange(24.0).reshape(*shape, 1) % 2.0
    shaded = {
        **gbuffer,
        "surface": _surface_record(*shape, metallic=either),
        **_records(lights=lights),
        "eye": np.array([0.2, 1.5, 2.5]),
    }
    around = {order: {"ambient": 0.3 * _normal(3, order**2) + np.eye(1, order**2)} for order in (1, 3, 5)}
    vectors = {"gbuffer.normal": "sphere", "gbuffer.geometric_normal": "sphere", "lights.direction": "sphere"}
    facets = 5.0 * _ulps_of_facets(0.5)  # five lights
    looked_up = {
        "gbuffer": _gbuffer_record(9),
        **_records(material=scenes.material(_rng), textures=scenes.textures(_rng)),
    }
    return [
        *(
            Case(
                f"{room}.incoming",
                {"light": _one_light(index, **finite), **position},
                label,
                gradients=("light", "position"),
                on={"light.direction": "sphere"},
            )
            for label, index in kinds.items()
        ),
        Case(f"{room}.incoming", {"light": _one_light(1), **position}, "lamp without end", gradients=("position",)),
        Case(
            f"{room}.incoming",
            {
                "light": _one_light(
                    3,
                    position=np.array([0.0, 1.0, 0.0]),
                    direction=np.array([0.0, -1.0, 0.0]),
                    cos_inner=np.array(0.8002),
                    cos_outer=np.array(0.8),
                ),
                "position": np.array([[math.sqrt(1.0 - c**2) / c, 0.0, 0.0] for c in (0.79, 0.8001, 0.8004, 0.802)]),
            },
            "narrow cone",
            ulps32=2048.0,  # a cosine near 1 against a cone of 10⁻³
        ),
        *(
            Case(
                f"{room}.shade",
                {**shaded, **more, "model": model},
                f"{model}, ambient {len(more)}",
                gradients=free,
                on=vectors,
                ulps32=facets,
            )
            for model, more, free in (
                ("metallic_roughness", {}, ()),
                ("metallic_roughness", around[3], ()),
                ("phong", around[5], ("gbuffer", "surface", "lights", "eye", "ambient")),
                ("lambert", around[1], ()),
            )
        ),
        Case(
            f"{room}.shade",
            {**shaded, "surface": _surface_record(*shape, metallic=_uniform(0.2, 0.8, *shape, 1))},
            "half metals",
            gradients=("surface",),
            ulps32=facets,
        ),
        Case(f"{room}.look_up_surface", {**looked_up, "max_anisotropy": 3}, "all textures", ulps32=LONG_SUM),
        Case(
            f"{room}.look_up_surface",
            {**looked_up, "max_anisotropy": 3, "slots": ("base_color_texture",)},
            "one texture",
            gradients=("gbuffer", "material", "textures"),
            ulps32=LONG_SUM,
        ),
        Case(f"{room}.look_up_surface", {**looked_up, "textures": None}, "no textures", gradients=("material",)),
    ]


def _late() -> list[Case]:
    return [
        Case(
            "deferred.late.alpha_to_coverage",
            {"alpha": np.concatenate([_uniform(0, 1, 4 * 5 * count - 2), [0.0, 1.0]]),
             "place": _rng.permutation(4 * 5 * count).astype(np.int32), "num_samples": count, "width": 5},
            f"{count} samples",
        )
        for count in (1, 2, 4, 8, 9, 16)
    ]  # fmt: skip


def _spoiled(image: np.ndarray, *pixels: tuple[int, int], value: float = np.nan) -> np.ndarray:
    """The image with one channel of some pixels not finite."""
    spoiled = image.copy()
    for k, (y, x) in enumerate(pixels):
        spoiled[y, x, k % image.shape[2]] = value
    return spoiled


def _box_filters() -> list[Case]:
    room, image = "filters.sat", _uniform(-1.0, 2.0, 6, 7, 2)
    spoiled = _spoiled(image, (0, 0), (0, 1), (1, 0), (1, 1), (4, 6))
    infinite = _spoiled(image[..., :1], (3, 3), value=-np.inf)
    return [
        # Sums of float32 values up to some ten: rounding of the whole table.
        Case(f"{room}.summed_area_table", {"image": image}, gradients=("image",), ulps32=LONG_SUM),
        *(
            Case(f"{room}.box_sum_from_table", {"table": table, "radius": r}, f"radius {r}", gradients=("table",))
            for table, r in ((_normal(6, 5, 2), 1), (_normal(4, 6, 1), 9))
        ),
        *(
            Case(f"{room}.{kernel}", {"image": x, "radius": r}, f"{label}, radius {r}", gradients=("image",))
            for kernel in ("box_mean", "box_variance")
            for label, x, r in (
                ("whole", image, 3),
                ("a corner and a border masked", spoiled, 1),
                ("infinite", infinite, 40),
                ("nothing", np.full((2, 3, 1), np.nan), 1),
            )
        ),
    ]


def _guided_filter() -> list[Case]:
    kernel, size = "filters.guided.guided_filter", (7, 9)
    guide, image = _uniform(0.0, 1.0, *size, 3), _normal(*size, 2)
    masked = {
        "guide": _spoiled(guide, (0, 8), (2, 2), (6, 0)),
        # All that the window of the lower right corner sees, and two pixels more.
        "image": _spoiled(image, (2, 2), (3, 5), *((y, x) for y in (5, 6) for x in (7, 8)), value=np.inf),
    }
    # A whole block of 2 x 2, and one of 3 x 3 at the border.
    blocks = *((y, x) for y in (9, 10) for x in (6, 7)), *((y, x) for y in (2, 3) for x in (2, 3))
    odd = {
        "guide": _spoiled(_uniform(0.0, 1.0, 11, 8, 2), (4, 4), (10, 7)),
        "image": _spoiled(_normal(11, 8, 1), *blocks),
    }
    step = np.where(np.arange(9.0) < 4, 0.2, 0.7) + 0.1 * _normal(*size)
    own = {"guide": step[..., None], "image": step[..., None]}
    number, per_channel, per_window = np.array(0.05), np.array([0.02, 0.1, 0.4]), _uniform(0.01, 0.2, *size, 3)
    by_3, by_2 = {"subsample": 3}, {"subsample": 2}
    aware, slopes = {"edge_aware": True}, ("guide", "image", "eps")
    seen = _rng.uniform(size=size) < 0.7
    planes = {"guide": np.moveaxis(guide, -1, 0), "image": np.moveaxis(image, -1, 0), "valid": seen}
    return [
        *(
            Case(
                kernel,
                {**images, "radius": radius, "eps": eps, **options},
                label,
                gradients=slopes,
                ulps32=LONG_SUM,  # differences of moments
            )
            for label, images, radius, eps, options in (
                ("number", {"guide": guide, "image": image}, 2, number, {}),
                ("masked, per channel", masked, 2, per_channel, {}),
                ("masked, per window and channel", masked, 1, per_window, {}),
                ("masked, per window, larger than the image", masked, 20, per_window[..., :1], {}),
                ("nothing", {"guide": np.full((2, 3, 1), np.nan), "image": np.ones((2, 3, 1))}, 1, number, {}),
                ("by 3, masked, per channel", odd, 4, per_channel[:2], by_3),
                ("by 2, masked, per window", odd, 1, _uniform(0.01, 0.2, 11, 8, 2), by_2),
                ("edge-aware, masked, per channel", masked, 2, per_channel, aware),
                ("own guide, edge-aware, by 2", own, 3, number, aware | by_2),
            )
        ),
        Case(
            "filters.guided.filter_planes",
            {**planes, "eps": per_channel[:, None, None], "radius": 2},
            gradients=slopes,
            ulps32=LONG_SUM,
        ),
        *(
            Case("filters.guided.edge_aware_eps", {"guide": x, "eps": eps}, label, gradients=("guide", "eps"))
            for label, x, eps in (
                ("masked, per channel", masked["guide"], per_channel),
                ("per window", own["guide"], per_window[..., :1]),
            )
        ),
        Case("filters.guided.edge_aware_eps", {"guide": np.full((3, 4, 2), 0.3), "eps": 0.1}, "constant"),
    ]


def _pair_filters() -> list[Case]:
    size = (6, 7)
    image, features = _normal(*size, 2), _uniform(0.0, 1.0, *size, 3)
    masked = {
        "image": _spoiled(image, (0, 0), (3, 3), (5, 6)),
        "features": _spoiled(features, (3, 3), (4, 1), value=np.inf),
    }
    whole = {"image": image, "features": features}
    number, each = np.array(0.6), np.array([0.4, 0.9, 0.6])
    slopes = ("image", "features", "sigma_features")
    # A firefly beside dark pixels, and one that is its own median.
    sparse = np.where(_rng.uniform(size=size) < 0.7, _uniform(0.1, 1.0, *size), 0.0)[..., None] * _uniform(0.5, 1, 3)
    sparse[2, 3] *= 60.0
    return [
        *(
            Case(
                "filters.bilateral.cross_bilateral_filter",
                {**images, "radius": radius, "sigma_spatial": np.array(1.5), "sigma_features": sigma},
                label,
                gradients=(*slopes, "sigma_spatial"),
            )
            for label, images, radius, sigma in (
                ("number", whole, 2, number),
                ("masked, per feature", masked, 1, each),
                ("masked, larger than the image", masked, 9, number),
            )
        ),
        *(
            Case(
                "filters.atrous.atrous_filter",
                {**images, "num_levels": levels, "sigma_features": sigma, **color},
                label,
                gradients=(*slopes, *color),
            )
            for label, images, levels, sigma, color in (
                ("number", whole, 2, number, {}),
                ("masked, per feature", masked, 3, each, {}),
                ("masked, color", masked, 2, number, {"sigma_color": np.array(2.0)}),
            )
        ),
        *(
            Case("filters.fireflies.clamp_fireflies", {"image": x, "factor": 4.0, "radius": r}, label)
            for label, x, r in (
                ("colors", sparse, 2),
                ("one channel", _spoiled(sparse[..., :1], (2, 2), value=np.inf), 1),
            )
        ),
    ]


def _denoising() -> list[Case]:
    radiance, albedo = _uniform(0.0, 4.0, 3, 4, 3), _uniform(0.1, 1.0, 3, 4, 3)
    albedo[0, 0, 1] = albedo[0, 1, :2] = albedo[0, 2] = 1e-4
    albedo[0, 3, 2] = np.nan
    image, filtered, share = _normal(5, 6, 3), _normal(5, 6, 3), _uniform(0.0, 0.8, 5, 6)
    judged = {"filtered": filtered, "share": share, "weight": _uniform(0.1, 1.0, 5, 6, 3)}
    # Wider than the windows that shares are means over.
    signs = np.sign(_normal(2, 22))
    return [
        Case("filters.albedo.demodulate", {"radiance": radiance, "albedo": albedo}, gradients=("radiance",)),
        Case("filters.albedo.remodulate", {"light": radiance, "albedo": albedo}, gradients=("light",)),
        *(
            Case(f"filters.albedo.{kernel}", {name: radiance[1:2], "albedo": albedo[1:2], "floor": 0.5}, "floor")
            for kernel, name in (("demodulate", "radiance"), ("remodulate", "light"))
        ),
        Case("filters.cross_validation.own_share", {"probe": signs, "filtered_probe": 0.5 * signs + _normal(2, 22)}),
        Case(
            "filters.cross_validation.leave_one_out_error",
            {"image": image, **judged},
            gradients=("image", "filtered", "share", "weight"),
        ),
        Case(
            "filters.cross_validation.leave_one_out_error",
            {"image": _spoiled(image, (0, 0), (4, 5)), **judged},
            "masked",
            gradients=("image", "filtered"),
        ),
    ]


def _rays() -> list[Case]:
    room, corners = "pathtrace", _normal(12, 3, 3)
    # Half of them at points inside, and half past an edge.
    inside = np.concatenate([_rng.dirichlet(np.ones(3), 6), [[-0.2, 0.6, 0.6]] * 2, [[0.6, -0.2, 0.6]] * 4])
    origins = _normal(12, 3) + np.array([0.0, 0.0, 4.0])
    directions = np.einsum("nk,nkj->nj", inside, corners) - origins
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    lost = {
        "corners": np.stack([flat, flat[[0, 1, 1]], flat]),
        "origins": np.array([[0.2, 0.3, 2.0]] * 3),
        "directions": np.array([[1.0, 2.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]),
    }
    axes = np.stack([np.cross(directions, _normal(12, 3)) for _ in range(2)], axis=-2)
    leaving = {
        "position": np.concatenate([_normal(6, 3), 1e4 * _normal(4, 3), 1e-2 * _normal(4, 3), np.zeros((1, 3))]),
        "geometric_normal": _unit(15),
        "direction": _normal(15, 3),
    }
    ray = {"origins": origins, "directions": directions}
    return [
        Case(
            f"{room}.hit_parameters.hit_parameters",
            {"corners": corners, **ray},
            gradients=("corners", *ray),
            ulps32=LONG_SUM,  # differences of positions, and faces met at grazing angles
        ),
        Case(f"{room}.hit_parameters.hit_parameters", lost, "nothing to hit"),
        Case(f"{room}.ray_triangle.ray_plane_axes", {"directions": np.concatenate([_SPHERE, np.zeros((1, 3))])}),
        Case(
            f"{room}.ray_triangle.hit_distance",
            {"corners": corners, **ray, "plane_axes": axes},
            ulps32=LONG_SUM,  # the same
        ),
        Case(f"{room}.ray_offset.offset_origin", leaving, gradients=("position",)),
    ]


def _vec(values: np.ndarray) -> Record:
    """(..., 3) as three arrays."""
    return Record("vec3.Vec3", {name: values[..., k].copy() for k, name in enumerate("xyz")})


def _three_vectors() -> list[Case]:
    a, b, n = _normal(6, 3), _normal(6, 3), _vec(_SPHERE)
    a[2] = 0.0
    both = {"a": _vec(a), "b": _vec(b)}
    one = {"v": _vec(a)}
    return [
        Case("vec3.from_array", {"values": a}, gradients=("values",)),
        Case("vec3.to_array", one, gradients=("v",)),
        Case("vec3.dot", both, gradients=("a", "b")),
        Case("vec3.cross", both, gradients=("a", "b")),
        *(Case(f"vec3.{name}", one, gradients=("v",)) for name in ("length", "normalize", "mean")),
        Case("vec3.largest", {"v": _vec(b)}, gradients=("v",)),
        Case("vec3.where", {"condition": a[:, 0] > 0.0, **both}, gradients=("a", "b")),
        Case("vec3.where", {"condition": a[:, 0] > 0.0, "a": both["a"], "b": 0.5}, "number", gradients=("a",)),
        Case("vec3.reflect", {"v": _vec(_normal(len(_SPHERE), 3)), "n": n}, gradients=("v",)),
        Case("vec3.tangents", {"n": n}),
    ]


def _words(*shape: int) -> np.ndarray:
    return _rng.integers(0, 2**32, shape, dtype=np.uint32)


def _sequences() -> list[Case]:
    """Exact: the same integers, and the same float32 numbers made of them."""
    room = "pathtrace.low_discrepancy"
    x = np.concatenate([_words(50), np.array([0, 1, 2**31, 2**32 - 1], np.uint32)])
    index = np.concatenate([np.arange(30), [1000, 12345, 2**31 - 1]]).astype(np.int32)
    return [
        Case(f"{room}.hash_words", {"x": x}),
        Case(f"{room}.reverse_bits", {"x": x}),
        Case(f"{room}.pixel_seeds", {"pixel": np.arange(40, dtype=np.int32), "seed": 7}),
        *(
            Case(
                f"{room}.uniform_pair",
                {"index": index, "seed": _words(len(index)), "dimension": d},
                f"dimension {d}",
                ulps64=0.0,
                ulps32=0.0,
            )
            for d in (0, 3, 1001)
        ),
    ]


def _environment_record(height: int = 4, width: int = 7) -> Record:
    """With a black row, a black texel, and a texel that shines more than all others."""
    image = _uniform(0.1, 1.0, height, width, 3)
    image[1], image[0, 2], image[2, 3] = 0.0, 0.0, [30.0, 20.0, 10.0]
    edges = np.cos(np.linspace(0.0, math.pi, height + 1))
    solid = np.repeat(-np.diff(edges)[:, None] * 2.0 * math.pi / width, width, axis=1)
    power = image.mean(-1) * solid
    chance = power / power.sum()
    inside = np.where(power.sum(1, keepdims=True) > 0.0, power, 1.0)
    columns = np.cumsum(inside, axis=1) / inside.sum(1, keepdims=True)
    fields = {"density": chance / solid, "rows": np.cumsum(chance.sum(1)), "columns": columns}
    fields["rows"][-1], fields["columns"][:, -1] = 1.0, 1.0
    return Record("pathtrace.environment.Environment", {"radiance": image, **fields})


def _surroundings() -> list[Case]:
    room = "pathtrace.environment"
    environment = {"environment": _environment_record()}
    directions = {"direction": _vec(_unit(40))}
    image = _uniform(0.0, 2.0, 5, 6, 3).astype(np.float32)
    image[2, 1:4] = 0.0
    # The tables are float32 on both sides, whatever the rest is in.
    single = {"host": True, "ulps64": ROUNDING * 2.0**29}
    return [
        Case(f"{room}.make_environment", {"image": image}, **single),
        Case(f"{room}.make_environment", {"image": 0.0 * image}, "black", **single),
        Case(f"{room}.texel_of", {**environment, **directions}),
        Case(f"{room}.look_up", {**environment, **directions}),
        Case(
            f"{room}.draw_direction",
            {**environment, "u": _uniform(0.0, 1.0, 40), "v": _uniform(0.0, 1.0, 40)},
            ulps32=LONG_SUM,  # what is left of a number within a texel, over its chance
        ),
    ]


def _lookups() -> list[Case]:
    height, width, n = 5, 6, 60
    normal, depth = _unit(height, width), _uniform(1.0, 3.0, height, width, 1)
    normal[:2, :2], normal[4, 3:5] = normal[0, 0], 0.0
    depth[:2, :2] = 2.0
    guides = {"image": _normal(height, width, 4), "normal": normal, "depth": depth}
    places = {
        "places_px": _uniform(-0.5, 6.5, n, 2),
        "sample_normal": np.concatenate([_unit(n // 2), np.tile(normal[0, 0], (n // 2, 1))]),
        "sample_depth": np.concatenate([_uniform(1.0, 3.0, n // 2, 1), np.full((n // 2, 1), 2.0)]),
    }
    arrived = _uniform(0.0, 1.0, 7, 8, 3)
    arrived[:3, :2] = 0.0
    whole = arrived + _uniform(0.0, 0.5, 7, 8, 3)
    whole[:3, :2] = 0.0
    ratio = {"arrived": arrived, "unshadowed": whole, "channels": _uniform(0.0, 1.0, 7, 8, 2)}
    eps = {"eps": np.array([0.02, 0.05])}
    return [
        Case("pathtrace.guide_lookup.guide_lookup", {**guides, **places}, gradients=("image",)),
        *(
            Case(
                "pathtrace.shadow_ratio.shadow_ratio",
                {**ratio, **eps, "radius": r},
                f"radius {r}",
                gradients=("arrived", "unshadowed"),
                ulps32=LONG_SUM,  # differences of moments, and a quotient
            )
            for r in (0, 2)
        ),
        *(
            Case("pathtrace.shadow_ratio.ratio_radius", {"shadow_rays": n, "group": g}, f"{g}, {n} rays", host=True)
            for n in (1, 2, 4, 16, 100)
            for g in ("area", "environment")
        ),
    ]


_MODELS = ("metallic_roughness", "phong", "lambert")


def _bent(n: np.ndarray, amount: float) -> np.ndarray:
    bent = n + amount * _normal(*n.shape)
    return bent / np.linalg.norm(bent, axis=-1, keepdims=True)


def _reflector_record(n: int) -> Record:
    """Points seen from the front of their triangle, some of them from behind their bent normal."""
    geometric = _unit(n)
    wo = _unit(n)
    wo *= np.sign((wo * geometric).sum(-1, keepdims=True))
    metallic, base = np.arange(n)[:, None] % 3 / 2.0, _uniform(0.1, 1.0, n, 3)
    fields = {
        "position": _vec(_uniform(-1.0, 1.0, n, 3)),
        "normal": _vec(_bent(geometric, 0.3)),
        "geometric_normal": _vec(geometric),
        "wo": _vec(wo),
        "diffuse": _vec(base * (1.0 - metallic)),
        "mirror": _vec(0.04 * (1.0 - metallic) + base * metallic),
        "roughness": _uniform(0.35, 1.0, n),
        "matt_share": np.where(metallic[:, 0] == 1.0, 0.0, _uniform(0.1, 0.9, n)),
    }
    return Record("pathtrace.scatter.Reflector", fields)


def _hit_surface_record(n: int) -> Record:
    geometric = _unit(n)
    triangle = np.arange(n, dtype=np.int32) % 7 - 1
    metallic = np.arange(n) % 3 / 2.0
    some = (triangle >= 0)[:, None]
    fields = {
        "triangle": triangle,
        "position": _vec(np.where(some, _uniform(-1.0, 1.0, n, 3), 0.0)),
        "normal": _vec(np.where(some, _bent(geometric, 0.2), 0.0)),
        "geometric_normal": _vec(np.where(some, geometric, 0.0)),
        "front": np.arange(n) % 2 == 0,
        "base_color": _vec(np.where(some, _uniform(0.1, 1.0, n, 3) * (np.arange(n) % 5 > 0)[:, None], 0.0)),
        "alpha": np.where(some[:, 0], _uniform(0.0, 1.0, n), 0.0),
        "metallic": metallic,
        "roughness": _uniform(0.3, 1.0, n),
        "emissive": _vec(np.where(some, _uniform(0.0, 2.0, n, 3), 0.0)),
    }
    return Record("pathtrace.hit_points.HitSurface", fields)


def _scattering() -> list[Case]:
    room, n = "pathtrace.scatter", 60
    at = {"at": _reflector_record(n)}
    wi = {"wi": _vec(_unit(n))}
    numbers = {name: _uniform(0.0, 1.0, n) for name in ("u", "v", "choice")}
    seen = {"surface": _hit_surface_record(n), "direction": _vec(_unit(n))}
    cases = [Case(f"{room}.reflectance", at, gradients=("at",))]
    for model in _MODELS:
        option = {"model": model}
        cases += [
            Case(f"{room}.make_reflector", {**seen, **option}, model),
            Case(f"{room}.evaluate", {**at, **wi, **option}, model, ulps32=LONG_SUM),  # powers of cosines
            Case(f"{room}.density", {**at, **wi, **option}, model, ulps32=LONG_SUM),
            Case(f"{room}.draw", {**at, **numbers, **option}, model, ulps32=16.0 * LONG_SUM),  # flanks of lobes
        ]
    return cases


def _table_record(*names: str, slots: tuple[str, ...] = (), **changed: np.ndarray) -> Record:
    """A `SurfaceTable` of the triangles of `scenes.scene`, from the definition of its columns."""
    rng = np.random.default_rng(91)
    scene, material, textures = scenes.scene(rng), scenes.material(rng), scenes.textures(rng)
    columns = {"position": "positions", "normal": "normals", "uv": "uv", "color": "colors", "tangent": "tangents"}
    values = np.concatenate([scene[columns[name]] for name in names], axis=1)
    a, b, c = (values[scene["faces"][:, k]] for k in range(3))
    p, q = scene["positions"][scene["faces"]], scene["uv"][scene["faces"]]
    doubled = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(doubled, axis=1, keepdims=True)
    edge_1, edge_2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    uv_area = np.abs(edge_1[:, :1] * edge_2[:, 1:] - edge_1[:, 1:] * edge_2[:, :1])
    fields = {
        "corners": np.concatenate([a, b - a, c - a, doubled / area, np.sqrt(uv_area / area)], axis=1),
        "material_id": scene["material_id"],
        "material": Record("scene.Material", material | changed),
        "textures": Record("deferred.texture.Textures", textures) if slots else None,
        "attributes": names,
        "slots": slots,
    }
    return Record("pathtrace.hit_points.SurfaceTable", fields)


_ALL_SLOTS = ("base_color_texture", "metallic_roughness_texture", "normal_texture", "emissive_texture")


def _by_name(result: dict) -> dict:
    return {name: result[name] for name in sorted(result)}


def _barycentrics(n: int) -> np.ndarray:
    corners = _rng.dirichlet([1.0, 1.0, 1.0], n)
    return corners[:, 1:].copy()


def _hit_points() -> list[Case]:
    room, n = "pathtrace.hit_points", 40
    whole = _table_record("position", "normal", "uv", "color", "tangent", slots=_ALL_SLOTS)
    bare = _table_record("position", "normal")
    triangle = np.arange(n, dtype=np.int32) % 27 - 1
    hits = {"triangle": triangle, "barycentrics": _barycentrics(n), "direction": _vec(_unit(n))}
    width = {"width": _uniform(0.001, 0.3, n)}
    rows = {
        name: table.fields["corners"][np.maximum(triangle, 0)].T.copy() for name, table in (("w", whole), ("b", bare))
    }
    points = {
        "triangle": triangle,
        "material_id": np.where(triangle >= 0, triangle % 4, 0).astype(np.int32),
        **{name: _vec(_normal(n, 3)) for name in ("position",)},
        **{name: _vec(_unit(n)) for name in ("normal", "geometric_normal", "tangent")},
        "handedness": np.where(np.arange(n) % 2 == 0, 1.0, -1.0),
        "front": np.arange(n) % 3 == 0,
        "u": _normal(n),
        "v": _normal(n),
        "uv_width": _uniform(0.0, 0.3, n),
        "color": _vec(_uniform(0.0, 1.0, n, 3)),
        "alpha": _uniform(0.0, 1.0, n),
    }
    points = {"points": Record("pathtrace.hit_points.HitPoints", points)}
    texels = {slot: _uniform(0.1, 1.0, n, 4) for slot in _ALL_SLOTS}
    long = {"ulps32": LONG_SUM}  # of coordinates and of levels
    return [
        Case(f"{room}.gather_corners", {"table": whole, "triangle": triangle}, gradients=("table",)),
        Case(
            f"{room}.interpolate",
            {"table": whole, "corners": rows["w"], **hits, **width},
            gradients=("barycentrics", "corners", "width"),
            **long,
        ),
        Case(
            f"{room}.interpolate",
            {"table": bare, "corners": rows["b"], **hits, "width": None},
            "bare",
            gradients=("barycentrics", "corners"),
            **long,
        ),
        Case(f"{room}.look_up_texels", {"table": whole, **points, "fine": True}, "fine", outcome=_by_name, **long),
        Case(f"{room}.look_up_texels", {"table": whole, **points, "fine": False}, outcome=_by_name, **long),
        Case(f"{room}.look_up_texels", {"table": bare, **points, "fine": True}, "no textures"),
        Case(f"{room}.apply_material", {"table": whole, **points, "texels": texels}, **long),
        Case(f"{room}.apply_material", {"table": bare, **points, "texels": {}}, "no textures", **long),
        Case(f"{room}.hit_surface", {"table": whole, **hits, **width}, ulps32=8.0 * LONG_SUM),  # texels per uv
        Case(f"{room}.hit_surface", {"table": bare, **hits}, "no textures", **long),
    ]


def _emitters_record(*groups: str) -> Record:
    """Eight of the triangles of `_table_record`, every second with two sides, and the lights of `scenes`."""
    corners = _table_record("position", "normal").fields["corners"]
    num, triangle = len(corners), np.arange(3, 19, 2, dtype=np.int32)
    a, e1, e2 = (corners[triangle, 6 * k : 6 * k + 3] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    emission = _uniform(0.5, 3.0, len(triangle), 3)
    power = area * emission.mean(1)
    chance, density = np.cumsum(power) / power.sum(), np.zeros(num)
    chance[-1] = 1.0
    density[triangle] = np.diff(chance, prepend=0.0) / area
    lights = scenes.lights()
    light_chance = np.cumsum([0.3, 0.2, 0.1, 0.3, 0.1])
    light_chance[-1] = 1.0
    fields = {
        "area_triangle": triangle,
        "area_chance": chance,
        "area_corners": np.concatenate([a, e1, e2, emission], axis=1),
        "area_density": density,
        "two_sided": np.arange(num) % 4 == 1,
        "lights": Record("scene.Lights", lights),
        "light_chance": light_chance,
        "environment": _environment_record(),
        "groups": groups,
    }
    return Record("pathtrace.emitters.Emitters", fields)


def _emitters() -> list[Case]:
    room, n = "pathtrace.emitters", 50
    emitters = {"emitters": _emitters_record("area", "lights", "environment")}
    plain, textured = _table_record("position", "normal"), _table_record("position", "normal", "uv", slots=_ALL_SLOTS)
    numbers = {name: _uniform(0.0, 1.0, n) for name in ("pick", "u", "v")}
    position = {"position": _vec(_uniform(-2.0, 2.0, n, 3))}
    triangle = np.arange(n, dtype=np.int32) % 27 - 1
    met = {"triangle": triangle, "distance": _uniform(0.1, 3.0, n), "cosine": _uniform(-1.0, 1.0, n)}
    drawn = {**emitters, **position, **numbers}
    return [
        Case(f"{room}.draw_area", {**drawn, "table": plain}, ulps32=LONG_SUM, gradients=("position",)),
        Case(f"{room}.draw_area", {**drawn, "table": textured}, "textured", ulps32=8.0 * LONG_SUM),
        Case(f"{room}.draw_light", {**emitters, **position, "pick": numbers["pick"]}, ulps32=LONG_SUM),
        Case(f"{room}.draw_environment", {**emitters, "u": numbers["u"], "v": numbers["v"]}, ulps32=LONG_SUM),
        Case(f"{room}.area_density", {**emitters, **met}, gradients=("distance", "cosine")),
        Case(f"{room}.emitted", {**emitters, "surface": _hit_surface_record(n)}),
        Case(f"{room}.only", {**emitters, "groups": ("lights", "area")}, outcome=_groups_alone),
    ]


def _groups_alone(emitters: Any) -> Any:
    assert emitters.groups == ("area", "lights")
    return emitters.area_chance


def _path_record(n: int) -> Record:
    fields = {
        "throughput": _vec(_uniform(0.0, 0.8, n, 3)),
        "density": _uniform(0.05, 2.0, n),
        "alive": np.arange(n) % 9 > 0,
        "shared": np.arange(n) % 4 > 0,
    }
    return Record("pathtrace.paths.Path", fields)


def _vertex_record(number: int, drawn: int, scattered: int, model: str = "metallic_roughness") -> Record:
    return Record("pathtrace.paths.Vertex", {"number": number, "drawn": drawn, "scattered": scattered, "model": model})


def _paths() -> list[Case]:
    room, n = "pathtrace.paths", 36
    emitters = _emitters_record("area", "lights", "environment")
    path, at = {"path": _path_record(n)}, {"at": _reflector_record(n)}
    sequence = {"seeds": _words(n), "index": np.array(5, np.int32)}
    ends = {"direction": _vec(_unit(n)), "distance": _uniform(0.5, 4.0, n), "surface": _hit_surface_record(n)}
    table = {"table": _table_record("position", "normal")}
    radii = np.array([0.5, 2.0])
    # Numbers of 24 bits, which float32 divides and halves again, and densities of peaks.
    long = {"ulps32": 16.0 * LONG_SUM}
    return [
        Case(f"{room}.begin", {"num_paths": 5}),
        Case(f"{room}.meet", {"emitters": emitters, **path, **ends, "left": _vertex_record(1, 2, 1)}, **long),
        *(
            Case(
                f"{room}.draw_lights",
                {"emitters": emitters, **table, **at, **path, **sequence, "vertex": _vertex_record(*numbers)},
                label,
                **long,
            )
            for label, numbers in (
                ("both ways", (1, 2, 1)),
                ("drawn only", (0, 3, 0, "lambert")),
                ("phong", (2, 1, 4, "phong")),
            )
        ),
        *(
            Case(
                f"{room}.go_on",
                {**at, **path, **sequence, "vertex": _vertex_record(number, 1, 1, model)},
                model,
                **long,
            )
            for number, model in zip((0, 2, 4), _MODELS, strict=True)
        ),
        Case(f"{room}.offset", {**at, "direction": _vec(_unit(n))}),
        Case(
            f"{room}.openness",
            {"distance": _uniform(0.1, 3.0, n), "triangle": np.arange(n, dtype=np.int32) % 5 - 1, "radii": radii},
            gradients=("distance",),
        ),
    ]


def _sharpness() -> list[Case]:
    room, n = "pathtrace.sharpness", 40
    levels, radii = {"levels": _uniform(0.0, 1.0, 4, 5, 6, 3)}, {"radii": np.array([9.0, 2.0, 1.0, 0.0])}
    return [
        Case(f"{room}.sharpness", {"at": _reflector_record(n)}),
        *(
            Case(f"{room}.window_radii", {"largest": r, "least": least}, f"{r} to {least}", host=True)
            for r, least in ((16, 0.0), (10, 1.0), (7, 0.4), (3, 3.0))
        ),
        Case(
            f"{room}.blend_windows", {**levels, **radii, "wanted": _uniform(0.0, 12.0, 5, 6, 1)}, gradients=("levels",)
        ),
    ]


def _backgrounds() -> list[Case]:
    inputs = {"image": _uniform(0.0, 2.0, 5, 6, 3), "direction": _vec(_unit(40))}
    return [Case("latlong.look_up_smoothly", inputs, gradients=("image",))]


def _motion() -> list[Case]:
    """What animations add, and directions of images."""
    skin, matrices = _skin_and_globals()
    image, previous = _uniform(0, 1, 2, 6, 7, 3)
    pair = {"image": image, "previous": previous}
    places = np.stack([_uniform(0.5, 6.5, 6, 7), _uniform(0.5, 5.5, 6, 7)], axis=-1)
    places[0, :2] = [[0.5, 0.5], [6.5, 5.5]]
    some = _uniform(0, 1, 6, 7) < 0.7
    some[0, :2] = True
    return [
        Case(
            "animation.skinning.skin_mesh",
            {"skin": skin, "globals": matrices, "tangents": _unit(6)},
            "own tangents",
            gradients=("globals", "tangents"),
        ),
        Case("latlong.environment_directions", {"height": 6, "width": 8}, host=True),
        Case("latlong.azimuths", {"width": 9}, host=True),
        Case("latlong.solid_angles", {"height": 7, "width": 3}, host=True),
        # Off the sphere both are continued differently, so slopes are not compared.
        Case("latlong.to_angles", {"direction": _vec(_unit(30))}),
        Case(
            "latlong.to_direction", {"cosine": _uniform(-0.99, 0.99, 30), "azimuth": _uniform(-3.1, 3.1, 30)},
            gradients=("cosine", "azimuth"), ulps32=LONG_SUM,
        ),
        Case("metrics.flicker", {"frames": _uniform(0, 1, 5, 6, 7, 3)}, gradients=("frames",)),
        Case(
            "metrics.warped_flicker", {**pair, "places_px": places, "matches": some},
            gradients=tuple(pair), ulps32=LONG_SUM,
        ),
        Case("metrics.warped_flicker", {**pair, "places_px": places, "matches": np.zeros_like(some)}, "none"),
    ]  # fmt: skip


CASES: tuple[Case, ...] = tuple(
    case
    for room in (
        _vecmath, _sh, _zh, _brdf_operator, _light, _zh_fit, _linear_model, _shading, _visibility,
        _pose_model, _skeleton, _skinning, _camera, _metrics, _scene, _texture, _quads, _warps, _brdf,
        _whole_scene, _deferred_shading, _late, _box_filters, _guided_filter, _pair_filters, _denoising, _rays,
        _three_vectors, _sequences, _surroundings, _lookups, _scattering, _hit_points, _emitters, _paths,
        _sharpness, _motion, _backgrounds,
    )
    for case in room()
)  # fmt: skip
