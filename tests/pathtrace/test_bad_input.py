"""What may be wrong with a scene, its lights or its view: one line, or a picture that is finite."""

import dataclasses

import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.pathtrace import TraceSettings, move, prepare, render
from jaxrender.pathtrace.guide_rays import trace_guides
from jaxrender.pathtrace.world import NO_LIGHTS
from jaxrender.scene import POINT
from tests.pathtrace.test_render import ABOVE, WHITE, camera, floor
from tests.support.rooms import light, matt, room, square

SIZE = {"height": 12, "width": 16}
ONE = TraceSettings(method="none", direct="plain", ao_rays=0, bounces=1)
LAMP = square((0, 2, 0), (0.5, 0, 0), (0, 0, 0.5), matt((0, 0, 0), emissive=(4.0, 4.0, 4.0)))
#: A triangle without area, two corners of which are one point.
LINE = (
    np.array([[0.0, 1, 0], [1.0, 1, 0], [1.0, 1, 0]]), np.array([[0, 1, 2]]), np.tile([0.0, 1, 0], (3, 1)),
    matt((0, 0, 0), emissive=(9.0, 9.0, 9.0)), np.zeros((3, 2)),
)  # fmt: skip


def spoiled(name: str, value: float):
    """A room whose scene, material or lamp has one bad number."""
    lamps = light(POINT, position=(0.0, 2.0, 0.0))
    scene = room(floor(), lights=lamps)
    for record, part in ((scene, None), (scene.material, "material"), (scene.lights, "lights")):
        if hasattr(record, name):
            # Of NumPy, as JAX looks for NaN in these tests.
            values = np.array(getattr(record, name))
            values.flat[0] = value
            changed = dataclasses.replace(record, **{name: values})
            return changed if part is None else dataclasses.replace(scene, **{part: changed})
    raise AssertionError(name)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("positions", np.nan, r"scene\.positions: expected finite numbers"),
        ("normals", np.inf, r"scene\.normals: expected finite numbers"),
        ("colors", np.nan, r"scene\.colors: expected finite numbers"),
        (
            "emissive",
            np.nan,
            r"scene\.material: emissive: expected finite numbers, got 1 NaN or Inf, first at \(0, 0\)",
        ),
        ("base_color", np.inf, r"scene\.material: base_color: expected finite numbers"),
        ("intensity", np.nan, r"lights: intensity: expected finite numbers, got 1 NaN or Inf"),
        ("intensity", -2.0, r"lights: intensity: expected numbers >= 0, got -2\.0"),
        ("position", np.inf, r"lights: position: expected finite numbers"),
        ("range", np.nan, r"lights: range: expected numbers > 0, or Inf, got nan"),
    ],
)
def test_numbers_that_are_none_are_named(name, value, message):
    bad = spoiled(name, value)
    with pytest.raises(ValueError, match=message):
        prepare(bad)
    with pytest.raises(ValueError, match=message):
        move(prepare(room(floor(), lights=light(POINT))), bad, lights=bad.lights)


def test_a_scene_of_nothing_is_refused():
    scene = room(floor())
    empty = dataclasses.replace(scene, faces=scene.faces[:0], material_id=scene.material_id[:0])
    with pytest.raises(ValueError, match=r"scene\.faces: expected at least one triangle, got none"):
        prepare(empty)


def test_more_triangles_than_memory_are_refused_before_anything_is_built(monkeypatch):
    monkeypatch.setattr("jaxrender.machine.available_memory", lambda: 6000)
    prepare(room(floor()))
    with pytest.raises(MemoryError, match=r"4 triangles: about 0\.0 GB needed, 0\.0 GB available"):
        prepare(room(floor(), LAMP))
    monkeypatch.setattr("jaxrender.machine.available_memory", lambda: None)
    prepare(room(floor(), LAMP))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0])
def test_surroundings_with_other_than_light_are_refused(wrong):
    image = np.array(WHITE)
    image[1, 2, 0] = wrong
    counts = "0 NaN or Inf and 1 negative ones" if wrong == -1.0 else "1 NaN or Inf and 0 negative ones"
    with pytest.raises(InputError, match=f"environment: radiance: expected finite numbers >= 0, got {counts}"):
        prepare(room(floor()), environment=image)


def test_lamps_without_area_are_neither_drawn_nor_divided_by():
    """The picture is that of the lamp alone, whatever the line claims to emit; alone, it is no light at all."""
    tiny = (1e-18 * LAMP[0], *LAMP[1:])
    with_line, without = prepare(room(floor(), LAMP, LINE, tiny)), prepare(room(floor(), LAMP))
    np.testing.assert_array_equal(with_line.emitters.area_triangle, without.emitters.area_triangle)
    assert np.isfinite(np.asarray(with_line.emitters.area_density)).all()
    found, truth = (trace_guides(world, ABOVE, settings=ONE, **SIZE) for world in (with_line, without))
    np.testing.assert_array_equal(found.direct, truth.direct)
    assert truth.direct.max() > 0.1
    assert prepare(room(floor(), LINE)).notes == (NO_LIGHTS,)


@pytest.mark.parametrize(
    "view",
    [
        camera((0.3, 0.0, 0.2), (0.0, 0.0, 0.0)),
        camera((0.3, 0.0, 0.2), (0.3, -1.0, 0.25)),
        camera((0, 2, 0), (1, 2, 0)),
    ],
    ids=["in the floor, along it", "on the floor, down", "in the lamp"],
)
def test_an_eye_on_a_surface_sees_finite_light(view):
    world = prepare(room(floor(), LAMP), environment=0.1 * WHITE)
    found = render(world, view, settings=dataclasses.replace(ONE, samples_per_pixel=2), **SIZE)
    assert np.isfinite(found.image).all() and (found.image >= 0.0).all()


def test_one_triangle_without_area_leaves_the_surroundings():
    world = prepare(room(LINE), environment=0.25 * WHITE)
    found = render(world, ABOVE, settings=TraceSettings(), **SIZE)
    np.testing.assert_allclose(found.image, 0.25, rtol=1e-6)
