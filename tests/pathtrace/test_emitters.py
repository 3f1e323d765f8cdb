"""Light drawn from triangles and lamps: irradiance against closed forms, densities against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxrender.deferred.shade import incoming
from jaxrender.deferred.texture import build_textures
from jaxrender.pathtrace.emitters import area_density, draw_area, draw_light, emitted, make_emitters, only
from jaxrender.pathtrace.hit_points import hit_surface, surface_table
from jaxrender.scene import Lights
from tests.pathtrace.made_up import directions_around, floating, make_scene, plain_material, rows, vec
from tests.support import oracles, scenes

DRAW_AREA, DRAW_LIGHT, DENSITY = jax.jit(draw_area), jax.jit(draw_light), jax.jit(area_density)
N = 20_000


def numbers(seed: int, n: int = N) -> list:
    return [jnp.asarray(x, jnp.float32) for x in np.random.default_rng(seed).uniform(size=(3, n)).astype(np.float32)]


def spread(place, n: int = N):
    return vec(np.broadcast_to(np.asarray(place, float), (n, 3)))


def prepared(positions, faces, *, emissive, double_sided=None, material_id=None, **more):
    """A scene whose materials glow, its table and its emitters."""
    emissive = np.atleast_2d(np.asarray(emissive, float))
    sides = np.zeros(len(emissive), bool) if double_sided is None else np.asarray(double_sided)
    material = plain_material(len(emissive), emissive=emissive, double_sided=sides)
    scene = make_scene(positions, faces, material=material, material_id=material_id, **more)
    table = surface_table(scene)
    return scene, table, make_emitters(scene, table)


#: 2 x 1.2, at height 2, shining down.
LAMP = np.array([[-1.0, 2.0, -0.6], [1.0, 2.0, -0.6], [1.0, 2.0, 0.6], [-1.0, 2.0, 0.6]])
DOWN = [[0, 1, 2], [0, 2, 3]]


def polygon_irradiance(corners: np.ndarray, place: np.ndarray, normal: np.ndarray) -> float:
    """Of radiance 1 from a polygon above the horizon: ½ |Σ angle of edge · (normal · unit cross of its ends)|.

    Lambert, Photometria, 1760; Baum, Rushmeier, Winget, "Improving Radiosity Solutions Through the Use of Analytically
    Determined Form Factors", 1989.
    """
    v = oracles.unit(corners - place)
    total = 0.0
    for a, b in zip(v, np.roll(v, -1, axis=0), strict=True):
        cross = np.cross(a, b)
        total += np.arctan2(np.linalg.norm(cross), a @ b) * (oracles.unit(cross) @ normal)
    return abs(total) / 2.0


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [1.5, 0.3, -0.4], [0.2, 1.0, 0.1], [3.0, -2.0, 5.0]])
@pytest.mark.parametrize("normal", [[0.0, 1.0, 0.0], [0.3, 0.9, -0.2]])
def test_the_irradiance_of_a_rectangle_has_a_closed_form(place, normal):
    _, table, emitters = prepared(LAMP, DOWN, emissive=[3.0, 2.0, 1.0])
    normal = oracles.unit(np.array(normal))
    light = DRAW_AREA(emitters, table, spread(place), *numbers(3))
    cosine = rows(light.wi) @ normal
    # The formula is for polygons that are wholly above the horizon.
    assert ((LAMP - place) @ normal > 0.0).all() and (cosine > 0.0).all()
    estimates = rows(light.radiance) * cosine[:, None]
    expected = polygon_irradiance(LAMP, np.array(place), normal) * np.array([3.0, 2.0, 1.0])
    assert (np.abs(estimates.mean(0) - expected) < 3.0 * estimates.std(0) / np.sqrt(N)).all()


def test_drawn_points_lie_evenly_on_triangles_chosen_by_power(rng):
    """Chi-square over four equal parts of each of three triangles of different size, radiance and side."""
    positions = np.concatenate([s * rng.normal(size=(3, 3)) + 4.0 * rng.normal(size=3) for s in (0.5, 1.0, 2.0)])
    faces = np.arange(9).reshape(3, 3)
    emissive = np.array([[8.0, 4.0, 0.0], [1.0, 1.0, 1.0], [0.2, 0.4, 0.6]])
    _, table, emitters = prepared(positions, faces, emissive=emissive, material_id=[0, 1, 2], double_sided=[True] * 3)
    light = DRAW_AREA(emitters, table, spread([0.0, 9.0, 0.0]), *numbers(4))
    place = rows(light.wi) * np.asarray(light.distance, np.float64)[:, None] + [0.0, 9.0, 0.0]
    corners = positions[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    counts = np.zeros((3, 4))
    for k, (a, b, c) in enumerate(corners):
        edges = np.stack([b - a, c - a], axis=1)
        uv, *_ = np.linalg.lstsq(edges, (place - a).T, rcond=None)
        flat = np.linalg.norm(edges @ uv - (place - a).T, axis=0) < 1e-4
        inside = flat & (uv > -1e-4).all(0) & (uv.sum(0) < 1.0001)
        # Halving its sides cuts a triangle into four of equal area.
        part = np.where(uv[0] > 0.5, 1, np.where(uv[1] > 0.5, 2, np.where(uv.sum(0) < 0.5, 3, 0)))
        counts[k] = [(inside & (part == i)).sum() for i in range(4)]
    power = area * emissive.mean(1)
    expected = np.repeat(power[:, None] / power.sum() * N / 4, 4, axis=1)
    assert counts.sum() == N
    assert ((counts - expected) ** 2 / expected).sum() < 11.0 + 4.0 * np.sqrt(22.0)


def crossings(triangle: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances along rays from one point to a triangle, inf where they pass by."""
    a, b, c = triangle
    systems = np.stack(np.broadcast_arrays(-directions, b - a, c - a), axis=-1)
    t, u, v = np.linalg.solve(systems, np.broadcast_to(origin - a, directions.shape)[..., None])[..., 0].T
    return np.where((t > 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0), t, np.inf)


def test_the_density_of_met_triangles_integrates_to_their_chance(rng):
    """Over all directions that meet a triangle, whatever is in front of it; none is a sliver or seen edge-on."""
    corners = []
    for middle in oracles.unit(rng.normal(size=(4, 3))):
        across = oracles.unit(np.cross(middle, [0.3, 0.5, -0.8]))
        angle = 2.0 * np.pi * (np.arange(3)[:, None] / 3.0 + rng.uniform())
        ring = np.cos(angle) * across + np.sin(angle) * np.cross(middle, across)
        corners.append(2.0 * middle + 0.8 * ring + rng.uniform(-0.3, 0.3, (3, 1)) * middle)
    emissive = rng.uniform(0.1, 1.0, (4, 3))
    _, _, emitters = prepared(
        np.concatenate(corners), np.arange(12).reshape(4, 3), emissive=emissive, material_id=np.arange(4),
        double_sided=[True] * 4,
    )  # fmt: skip
    chance, total = [], []
    for index, triangle in enumerate(corners):
        middle = oracles.unit(triangle.mean(0))
        wi, solid = directions_around(middle, rings=500, azimuths=192)
        near = wi @ middle > 0.8
        assert (oracles.unit(triangle) @ middle > 0.8).all()
        wi, solid = wi[near], solid[near]
        t = crossings(triangle, np.zeros(3), wi)
        hit = np.isfinite(t)
        doubled = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        cosine = np.where(hit, wi @ oracles.unit(doubled), 1.0)
        arrays = (jnp.asarray(x, jnp.float32) for x in (np.where(hit, t, 0.0), cosine))
        density = DENSITY(emitters, jnp.full(len(hit), index, jnp.int32), *arrays)
        total.append((np.asarray(density, np.float64) * solid).sum())
        chance.append(np.linalg.norm(doubled) * emissive[index].mean())
    # Edges of triangles cut through cells, a hundredth of their size.
    np.testing.assert_allclose(total, np.array(chance) / sum(chance), rtol=5e-3)


@pytest.mark.parametrize("two_sided", [False, True])
def test_drawn_and_met_densities_agree(two_sided, rng):
    _, table, emitters = prepared(LAMP, DOWN, emissive=[1.0, 2.0, 3.0], double_sided=[two_sided])
    place = rng.uniform([-2.0, -1.0, -2.0], [2.0, 1.5, 2.0], (2000, 3))
    light = DRAW_AREA(emitters, table, vec(place), *numbers(5, 2000))
    found = DENSITY(emitters, jnp.zeros(2000, jnp.int32), light.distance, light.wi.y)
    # Both triangles have one density over area.
    np.testing.assert_allclose(light.density, found, rtol=2e-6)
    nothing = DENSITY(emitters, jnp.full(2000, -1, jnp.int32), light.distance, light.wi.y)
    assert (np.asarray(nothing) == 0.0).all()


@pytest.mark.parametrize("two_sided", [False, True])
def test_backs_shine_only_where_there_are_two_sides(two_sided):
    _, table, emitters = prepared(LAMP, DOWN, emissive=[1.0, 1.0, 1.0], double_sided=[two_sided])
    above, below = (DRAW_AREA(emitters, table, spread([0.3, y, 0.0], 100), *numbers(6, 100)) for y in (3.0, 1.0))
    assert (rows(below.radiance) > 0.0).all()
    assert (rows(above.radiance) > 0.0).all() == two_sided and (rows(above.radiance) == 0.0).all() != two_sided
    middle = jnp.full((1, 2), 0.3, jnp.float32)
    for direction, shines in (([0.0, 1.0, 0.0], True), ([0.0, -1.0, 0.0], two_sided)):
        surface = hit_surface(table, jnp.zeros(1, jnp.int32), middle, vec([direction]))
        assert (rows(emitted(emitters, surface)) == float(shines)).all()
    missed = hit_surface(table, jnp.full(1, -1, jnp.int32), middle, vec([[0.0, 1.0, 0.0]]))
    assert (rows(emitted(emitters, missed)) == 0.0).all()


def test_in_the_plane_of_a_lamp_nothing_arrives_and_all_is_finite():
    _, table, emitters = prepared(LAMP, DOWN, emissive=[1.0, 1.0, 1.0], double_sided=[True])
    for place in ([3.0, 2.0, 0.0], [0.0, 2.0, 0.0], LAMP[0]):
        light = DRAW_AREA(emitters, table, spread(place, 500), *numbers(7, 500))
        assert (rows(light.radiance) == 0.0).all()
        assert all(np.isfinite(np.asarray(x)).all() for x in (*light.wi, light.distance, light.density))


def test_triangles_without_area_or_light_are_left_out():
    """A needle between two corners, a point, a black one: none is drawn, and none takes a chance from the others."""
    positions = np.concatenate([LAMP, [[5.0, 5.0, 5.0]]])
    faces = [*DOWN, [0, 1, 1], [4, 4, 4], [0, 1, 4]]
    _, table, emitters = prepared(positions, faces, emissive=[[1.0] * 3, [0.0] * 3], material_id=[0, 0, 0, 0, 1])
    np.testing.assert_array_equal(emitters.area_triangle, [0, 1])
    np.testing.assert_array_equal(np.asarray(emitters.area_density) > 0.0, [True, True, False, False, False])
    np.testing.assert_allclose(emitters.area_chance, [0.5, 1.0])
    assert emitters.groups == ("area",)
    light = DRAW_AREA(emitters, table, spread([0.0, 0.0, 0.0], 100), *numbers(8, 100))
    assert np.isfinite(rows(light.radiance)).all() and (rows(light.radiance) > 0.0).all()


def test_a_textured_lamp_shines_as_its_texels_do():
    """Four texels, one of them black, by quadrature over the lamp: 64 x 64 midpoints."""
    texels = np.float32([[[1.0, 0.2, 0.0], [0.0, 0.0, 0.0]], [[0.3, 0.9, 0.5], [0.1, 0.1, 1.0]]])
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    textures = build_textures([np.repeat(np.repeat(texels, 8, axis=0), 8, axis=1)], wrap="clamp")
    material = plain_material(1, emissive=np.array([[2.0, 4.0, 6.0]]), emissive_texture=np.zeros(1, np.int32))
    scene = make_scene(LAMP, DOWN, material=material, uv=uv)
    table = surface_table(scene, textures=textures)
    assert table.slots == ("emissive_texture",)
    emitters = make_emitters(scene, table)
    light = DRAW_AREA(emitters, table, spread([0.4, 0.0, 0.2]), *numbers(9))
    estimates = rows(light.radiance) * rows(light.wi)[:, 1:2]
    cells = 64
    s = (np.arange(cells) + 0.5) / cells
    u, v = (x.ravel() for x in np.meshgrid(s, s))
    away = np.stack([2.0 * u - 1.0, np.full(u.shape, 2.0), 1.2 * v - 0.6], axis=1) - [0.4, 0.0, 0.2]
    distance = np.linalg.norm(away, axis=1)
    geometry = (away[:, 1] / distance) ** 2 / distance**2 * 2.4 / cells**2
    # Between blocks of 8 texels the lookup is bilinear: the share of half a texel on either side.
    fine = np.repeat(np.repeat(texels, 8, axis=0), 8, axis=1).astype(float)
    value = np.stack(
        [map_coordinates(fine[..., k], [16 * v - 0.5, 16 * u - 0.5], order=1, mode="nearest") for k in range(3)], axis=1
    )
    expected = (value * [2.0, 4.0, 6.0] * geometry[:, None]).sum(0)
    # A few thousandths are the quadrature's.
    assert (np.abs(estimates.mean(0) - expected) < 3.0 * estimates.std(0) / np.sqrt(N) + 3e-3 * expected).all()


def lamps(count: int | None = None, **changed) -> Lights:
    return floating(Lights(**{name: values[:count] for name, values in (scenes.lights() | changed).items()}))


def test_lights_without_extent_are_those_of_deferred_shading(rng):
    """Each draw is `incoming` of one light over its chance; all are drawn, as often as their chances say."""
    lights = lamps()
    scene = make_scene(LAMP, DOWN, material=plain_material(), lights=lights)
    emitters = make_emitters(scene, surface_table(scene))
    place = rng.uniform(-1.0, 1.0, (N, 3))
    light = DRAW_LIGHT(emitters, vec(place), numbers(10)[0])
    chance = np.diff(np.asarray(emitters.light_chance, np.float64), prepend=0.0)
    wi, radiance = rows(light.wi), rows(light.radiance)
    counts, distance = np.zeros(5), np.asarray(light.distance)
    taken = np.zeros(N, int)
    for k in range(5):
        one = jax.tree.map(lambda x, k=k: x[k], lights)
        towards, irradiance = (np.asarray(x) for x in incoming(one, jnp.asarray(place, jnp.float32)))
        far = int(one.kind) == 0
        expected = np.full(N, np.inf) if far else np.linalg.norm(np.asarray(one.position) - place, axis=1)
        own = (np.abs(wi - towards).max(1) < 1e-5) & np.isclose(distance, expected, atol=1e-4)
        np.testing.assert_allclose(radiance[own], irradiance[own] / chance[k], rtol=1e-5, atol=1e-6)
        counts[k] = own.sum()
        taken += own
    assert (taken == 1).all() and (np.asarray(light.density) == 0.0).all()
    assert ((counts - N * chance) ** 2 / (N * chance)).sum() < 4.0 + 4.0 * np.sqrt(8.0)


def test_few_lights_are_drawn_alike_and_many_by_power():
    scene = make_scene(LAMP, DOWN, material=plain_material())
    table = surface_table(scene)
    few = make_emitters(scene, table, lights=lamps(4))
    np.testing.assert_allclose(few.light_chance, [0.25, 0.5, 0.75, 1.0])
    many = make_emitters(scene, table, lights=lamps())
    power = scenes.lights()["intensity"].mean(1)
    chance = np.diff(np.asarray(many.light_chance, np.float64), prepend=0.0)
    np.testing.assert_allclose(chance, power / power.sum(), atol=3e-3)
    dark = make_emitters(scene, table, lights=lamps(intensity=np.zeros((5, 3))))
    np.testing.assert_allclose(dark.light_chance, [0.2, 0.4, 0.6, 0.8, 1.0])


def test_the_groups_are_those_there_are():
    scene = make_scene(LAMP, DOWN, material=plain_material(1, emissive=np.ones((1, 3))), lights=lamps())
    table = surface_table(scene)
    everything = make_emitters(scene, table, environment=np.ones((2, 4, 3)))
    assert everything.groups == ("area", "lights", "environment")
    assert only(everything, ("environment", "area")).groups == ("area", "environment")
    assert make_emitters(scene, table, environment=np.zeros((2, 4, 3))).environment is None
    dark = make_scene(LAMP, DOWN, material=plain_material())
    assert make_emitters(dark, surface_table(dark)).groups == ()
