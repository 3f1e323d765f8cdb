"""One vertex of a path: weights of drawn and met light, a white furnace, ends by chance, origins off the surface."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.emitters import Emitters, draw_light, make_emitters, only
from jaxrender.pathtrace.hit_points import HitSurface, SurfaceTable, hit_surface, surface_table
from jaxrender.pathtrace.low_discrepancy import pixel_seeds
from jaxrender.pathtrace.paths import ROULETTE_FROM, Path, Vertex, begin, draw_lights, go_on, meet, offset, openness
from jaxrender.pathtrace.scatter import MODELS, Reflector, density, evaluate, make_reflector
from jaxrender.scene import Lights
from tests.pathtrace.made_up import (
    directions_around,
    floating,
    make_scene,
    no_lights,
    plain_material,
    reflector,
    repeated,
    rows,
    vec,
)
from tests.support import oracles, scenes

# Compiling is most of the time here.
_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
DRAW, GO_ON, MEET = (
    _jit(f, static_argnames=name) for f, name in ((draw_lights, "vertex"), (go_on, "vertex"), (meet, "left"))
)
EVALUATE, DENSITY = (_jit(f, static_argnames="model") for f in (evaluate, density))
HIT, MAKE = _jit(hit_surface), _jit(make_reflector, static_argnames="model")
N = 8192


def surface_of(fields: dict[str, np.ndarray]) -> HitSurface:
    n = len(fields["normal"])
    number = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return HitSurface(
        triangle=jnp.zeros(n, jnp.int32), position=vec(fields["position"]), normal=vec(fields["normal"]),
        geometric_normal=vec(fields["geometric_normal"]), front=jnp.ones(n, bool),
        base_color=vec(fields["base_color"]), alpha=jnp.ones(n), metallic=number(fields["metallic"]),
        roughness=number(fields["roughness"]), emissive=vec(np.zeros((n, 3))),
    )  # fmt: skip


def point(model: str, *, n: int = N, **material) -> Reflector:
    """One point at the origin, seen from the side, n times."""
    fields = reflector([0.0, 1.0, 0.0], oracles.unit(np.array([0.5, 0.8, 0.2])), **material)
    return repeated(MAKE(surface_of(fields), -vec(fields["wo"]), model=model), n)


def seeds(n: int = N):
    return pixel_seeds(jnp.arange(n, dtype=jnp.int32), 1)


def zero() -> jax.Array:
    return jnp.zeros((), jnp.int32)


#: Above the point, shining down.
LAMP = np.array([[-2.0, 1.5, -1.0], [1.0, 1.5, -1.0], [1.0, 1.5, 2.0], [-2.0, 1.5, 2.0]])
RADIANCE = np.array([3.0, 2.0, 1.0])


@functools.cache
def lit(environment: bool = False, lights: int = 0) -> tuple[SurfaceTable, Emitters]:
    """A lamp of two triangles, surroundings, and lights without extent."""
    material = plain_material(1, emissive=RADIANCE[None])
    lamps = floating(Lights(**{k: v[:lights] for k, v in scenes.lights().items()})) if lights else no_lights()
    scene = make_scene(LAMP, [[0, 1, 2], [0, 2, 3]], material=material, lights=lamps)
    table = surface_table(scene)
    image = np.random.default_rng(3).uniform(0.2, 2.0, (6, 9, 3)) if environment else None
    return table, make_emitters(scene, table, environment=image)


def hits_of(table: SurfaceTable, wi: np.ndarray) -> tuple[HitSurface, np.ndarray]:
    """Where rays from the origin meet the lamp, and at what distance; -1 where they do not."""
    t = 1.5 / np.where(wi[:, 1] > 1e-3, wi[:, 1], 1.0)
    place = wi * t[:, None]
    s, r = (place[:, 0] + 2.0) / 3.0, (place[:, 2] + 1.0) / 3.0
    inside = (wi[:, 1] > 1e-3) & (np.minimum(s, r) > 0.0) & (np.maximum(s, r) < 1.0)
    # Triangle 0 has the corners (0, 0), (1, 0), (1, 1) in (s, r), triangle 1 (0, 0), (1, 1), (0, 1).
    triangle = np.where(inside, np.where(s >= r, 0, 1), -1).astype(np.int32)
    barycentrics = np.where((triangle == 0)[:, None], np.stack([s - r, r], 1), np.stack([s, r - s], 1))
    found = HIT(table, jnp.asarray(triangle), jnp.asarray(barycentrics, jnp.float32), vec(wi))
    return found, np.where(inside, t, np.inf)


@pytest.mark.parametrize(
    ("model", "drawn", "scattered", "environment"),
    [("lambert", 1, 1, False), ("metallic_roughness", 4, 1, False), ("phong", 2, 3, False), ("lambert", 2, 3, True)],
)
def test_weights_of_drawn_and_met_light_add_up_to_1(model, drawn, scattered, environment):
    """S w_drawn + B w_met = 1 for the direction of each drawn light: the light, as either way counts it."""
    table, emitters = lit(environment)
    emitters = only(emitters, ("environment",)) if environment else emitters
    at = point(model, base=(0.7, 0.6, 0.5), metallic=0.4, roughness=0.5)
    vertex = Vertex(1, drawn, scattered, model)
    path = begin(N)._replace(throughput=vec(np.tile([0.5, 0.4, 0.3], (N, 1))))
    for ray in DRAW(emitters, table, at, path, seeds(), zero(), vertex=vertex):
        wi = rows(ray.direction)
        p_b = DENSITY(at, ray.direction, model=model)
        surface, t = hits_of(table, wi)
        if environment:
            surface = surface._replace(triangle=jnp.full(N, -1, jnp.int32), emissive=vec(np.zeros((N, 3))))
            distance = jnp.full(N, jnp.inf)
        else:
            distance = jnp.asarray(t, jnp.float32)
            np.testing.assert_allclose(ray.distance, t * (1.0 - 1e-4), rtol=1e-5)
        through = path._replace(density=p_b)
        met = rows(MEET(emitters, through, ray.direction, distance, surface, left=vertex))
        f = rows(EVALUATE(at, ray.direction, model=model))
        seen = (f > 0.0).all(1) & (np.asarray(p_b) > 1e-6)
        # Met is β L w_met, and β L where no light is drawn; from w_met follows the p_l that it was made with.
        single = rows(MEET(emitters, through, ray.direction, distance, surface, left=Vertex(1, 0, 1, model)))
        w_met = met[seen] / single[seen]
        density_l = (1.0 / w_met - scattered) * np.asarray(p_b, np.float64)[seen, None] / drawn
        # Drawn is β f L w_drawn / p_l.
        w_drawn = rows(ray.light)[seen] / (f[seen] * single[seen]) * density_l
        assert seen.sum() > N / 3
        # Directions that rounding puts on the edge of the next texel have another radiance.
        total = drawn * w_drawn + scattered * w_met
        assert (np.abs(total - 1.0) < 2e-3).mean() > 0.998


@pytest.mark.parametrize(("model", "drawn"), [*((model, 1) for model in MODELS), ("lambert", 3)])
def test_one_vertex_in_a_white_furnace(model, drawn):
    """Surroundings of radiance 1: what is drawn and what is met together is ∫ f cos, for a matt surface its albedo."""
    scene = make_scene(LAMP + 100.0, [[0, 1, 2]], material=plain_material())
    table = surface_table(scene)
    emitters = make_emitters(scene, table, environment=np.ones((4, 8, 3)))
    at = point(model, base=(0.9, 0.6, 0.3), metallic=0.5, roughness=0.4)
    vertex, path = Vertex(0, drawn, 1, model), begin(N)
    light = sum(rows(ray.light) for ray in DRAW(emitters, table, at, path, seeds(), zero(), vertex=vertex))
    rays, onwards = GO_ON(at, path, seeds(), zero(), vertex=vertex)
    missed = surface_of(reflector(np.tile([0.0, 1.0, 0.0], (N, 1)), [0.0, 1.0, 0.0]))
    missed = missed._replace(triangle=jnp.full(N, -1, jnp.int32))
    light = light + rows(MEET(emitters, onwards, rays.direction, jnp.full(N, jnp.inf), missed, left=vertex))
    wi, solid = directions_around(np.array([0.0, 1.0, 0.0]))
    expected = solid @ rows(EVALUATE(repeated(jax.tree.map(lambda x: x[:1], at), len(wi)), vec(wi), model=model))
    if model == "lambert":
        np.testing.assert_allclose(expected, [0.9, 0.6, 0.3], rtol=2e-3)
    assert (np.abs(light.mean(0) - expected) < 4.0 * light.std(0) / np.sqrt(N) + 2e-3 * expected).all()


@pytest.mark.parametrize("shared", [False, True])
def test_a_lamp_is_found_once_whichever_way(shared):
    """Direct light of the lamp: drawn and met together, or drawn alone, have one mean."""
    table, emitters = lit()
    at, vertex = point("metallic_roughness", base=(0.9, 0.6, 0.3), roughness=0.4), Vertex(0, 2, 1, "metallic_roughness")
    path = begin(N)._replace(shared=jnp.full(N, shared))
    light = sum(rows(ray.light) for ray in DRAW(emitters, table, at, path, seeds(), zero(), vertex=vertex))
    rays, onwards = GO_ON(at, path, seeds(), zero(), vertex=vertex)
    surface, t = hits_of(table, rows(rays.direction))
    distance = jnp.asarray(np.where(np.isinf(t), 1.0, t), jnp.float32)
    met = rows(MEET(emitters, onwards, rays.direction, distance, surface, left=vertex))
    assert (met.any(axis=1).mean() > 0.1) == shared
    wi, solid = directions_around(oracles.unit(np.array([-0.3, 1.0, 0.2])))
    f = rows(EVALUATE(repeated(jax.tree.map(lambda x: x[:1], at), len(wi)), vec(wi), model=vertex.model))
    expected = (solid[:, None] * f * (np.asarray(hits_of(table, wi)[0].triangle) >= 0)[:, None]).sum(0) * RADIANCE
    total = light + met
    # Edges of the lamp cut through cells.
    assert (np.abs(total.mean(0) - expected) < 4.0 * total.std(0) / np.sqrt(N) + 3e-3 * expected).all()


def test_lights_without_extent_are_drawn_once_each():
    """As many draws as there are lights, up to 4: the parts of the picks hold one light each, and the sum is exact."""
    table, emitters = lit(lights=4)
    emitters = only(emitters, ("lights",))
    at, vertex = point("lambert", base=(0.8, 0.8, 0.8)), Vertex(0, 4, 1, "lambert")
    rays = DRAW(emitters, table, at, begin(N), seeds(), zero(), vertex=vertex)
    total = sum(rows(ray.light) for ray in rays)
    expected = np.zeros(3)
    for k in range(4):
        pick = jnp.full(1, (k + 0.5) / 4, jnp.float32)
        light = draw_light(emitters, vec([[0.0, 0.0, 0.0]]), pick)
        f = rows(EVALUATE(jax.tree.map(lambda x: x[:1], at), light.wi, model="lambert"))
        expected += (f * rows(light.radiance))[0] / 4
    np.testing.assert_allclose(total, np.tile(expected, (N, 1)), rtol=1e-4)
    assert len(rays) == 4


def test_paths_that_ended_bring_and_find_nothing():
    table, emitters = lit(True, lights=3)
    at, vertex = point("metallic_roughness", roughness=0.5), Vertex(1, 1, 1, "metallic_roughness")
    path = begin(N)._replace(alive=jnp.arange(N) % 2 == 0)
    rays = DRAW(emitters, table, at, path, seeds(), zero(), vertex=vertex)
    assert len(rays) == 3
    for ray in rays:
        assert (rows(ray.light)[1::2] == 0.0).all() and rows(ray.light)[::2].any()
    onwards, after = GO_ON(at, path, seeds(), zero(), vertex=vertex)
    assert not np.asarray(after.alive)[1::2].any() and (rows(after.throughput)[1::2] == 0.0).all()
    surface, t = hits_of(table, rows(onwards.direction))
    distance = jnp.asarray(np.where(np.isinf(t), 1.0, t), jnp.float32)
    met = rows(MEET(emitters, after, onwards.direction, distance, surface, left=vertex))
    assert (met[1::2] == 0.0).all() and met[::2].any()


@pytest.mark.parametrize("throughput", [0.02, 0.4, 3.0])
def test_ending_at_random_leaves_the_mean(throughput):
    """What goes on counts for more: chance q of the largest component, between 0.05 and 1."""
    at = point("lambert", base=(1.0, 0.5, 0.25))
    path = begin(N)._replace(throughput=vec(np.full((N, 3), throughput)))
    before, after = (GO_ON(at, path, seeds(), zero(), vertex=Vertex(k, 1, 1, "lambert"))[1]
                     for k in (ROULETTE_FROM - 1, ROULETTE_FROM))  # fmt: skip
    assert np.asarray(before.alive).all()
    np.testing.assert_allclose(
        rows(before.throughput), np.tile([throughput, throughput / 2, throughput / 4], (N, 1)), rtol=1e-5
    )
    chance = np.clip(throughput, 0.05, 1.0)
    alive = np.asarray(after.alive)
    assert abs(alive.mean() - chance) <= 4.0 * np.sqrt(chance * (1.0 - chance) / N)
    found = rows(after.throughput)
    np.testing.assert_allclose(found[alive], np.tile(rows(before.throughput)[0] / chance, (alive.sum(), 1)), rtol=1e-5)
    deviation = found.std(0) / np.sqrt(N)
    assert (np.abs(found.mean(0) - rows(before.throughput)[0]) <= 4.0 * deviation + 1e-6).all()
    assert (found[~alive] == 0.0).all()


def test_a_path_that_carries_no_light_ends():
    at = point("lambert", base=(0.0, 0.0, 0.0))
    _, after = GO_ON(at, begin(N), seeds(), zero(), vertex=Vertex(0, 1, 1, "lambert"))
    assert not np.asarray(after.alive).any()


@pytest.mark.parametrize("size", [1e-3, 1.0, 37.0, 1e4])
def test_origins_leave_the_plane_by_more_than_rounding(size, rng):
    """On the side of the direction; the distance to the exact plane, which no point of float32 lies on, in float64."""
    n = 4000
    normal, place = oracles.unit(rng.normal(size=(n, 3))), rng.uniform(-size, size, (n, 3))
    place, direction = place.astype(np.float32), oracles.unit(rng.normal(size=(n, 3)))
    fields = reflector(normal, normal) | {"position": place}
    at = MAKE(surface_of(fields), -vec(normal), model="lambert")
    origin = rows(offset(at, vec(direction)))
    side = np.sign((direction * normal).sum(1))
    away = ((origin - place) * normal).sum(1) * side
    # What rounding may move a point along the normal: half a unit in the last place of each coordinate.
    rounding = (0.5 * np.spacing(np.abs(place)).astype(np.float64) * np.abs(normal)).sum(1)
    clear = np.abs((direction * normal).sum(1)) > 1e-6
    assert (away > 4.0 * rounding)[clear].all()
    # 256 units along each axis, or 1/65536 near 0.
    assert away.max() < 256.0 * np.spacing(np.float32(size)) * np.sqrt(3.0) + 1.01 / 65536.0


def test_rays_leave_on_either_side_of_a_surface():
    at = point("lambert", n=2)
    up, down = rows(offset(at, vec([[0.1, 0.9, 0.0], [0.1, -0.9, 0.0]])))
    assert up[1] > 0.0 > down[1] and up[0] == down[0] == 0.0


def test_openness_is_the_share_of_the_radius():
    distance, triangle = jnp.asarray([0.5, 2.0, 4.0, 1.0]), jnp.asarray([3, 0, 1, -1], jnp.int32)
    near, far = openness(distance, triangle, jnp.asarray([1.0, 8.0]))
    np.testing.assert_allclose(near, [0.5, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(far, [0.0625, 0.25, 0.5, 1.0])


def test_paths_begin_with_all_light():
    path = begin(3)
    assert isinstance(path, Path) and (rows(path.throughput) == 1.0).all() and np.asarray(path.alive).all()
