"""One function, three kinds of geometry."""

import numpy as np
import pytest

from jaxrender.pathtrace.bvh import build_bvh
from jaxrender.pathtrace.embree import EmbreeScene
from jaxrender.pathtrace.instances import build_instances
from jaxrender.pathtrace.rays import trace_rays
from tests.support.rays import triangle_soup

BACKENDS = {
    "embree": EmbreeScene,
    "bvh": build_bvh,
    "instances": lambda *mesh: build_instances([build_bvh(*mesh)], np.zeros(1, int), np.eye(3, 4)[None]),
}


@pytest.fixture(params=BACKENDS)
def build(request):
    return BACKENDS[request.param]


def test_the_backends_agree(rng, build):
    vertices, faces, origins, directions = triangle_soup(rng, 256)
    geometry, embree = build(vertices, faces), EmbreeScene(vertices, faces)
    limit = rng.uniform(0, 5, len(origins)).astype(np.float32)
    for options in ({}, {"max_distance": limit}):
        ours, theirs = (trace_rays(x, origins, directions, **options) for x in (geometry, embree))
        assert 40 < (theirs.triangle >= 0).sum() < 220
        np.testing.assert_array_equal(ours.triangle, theirs.triangle)
        np.testing.assert_allclose(ours.t, theirs.t, rtol=1e-5)
        np.testing.assert_allclose(ours.barycentrics, theirs.barycentrics, atol=1e-4)
        found = trace_rays(geometry, origins, directions, query="any", **options)
        np.testing.assert_array_equal(found, theirs.triangle >= 0)


def test_misses_have_the_same_values(build):
    geometry = build(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    hits = trace_rays(geometry, np.full((2, 3), 2.0, np.float32), np.ones((2, 3), np.float32))
    np.testing.assert_array_equal(hits.triangle, [-1, -1])
    np.testing.assert_array_equal(hits.t, [np.inf, np.inf])
    np.testing.assert_array_equal(hits.barycentrics, np.zeros((2, 2)))


def test_a_ray_that_starts_on_a_face_meets_it(build):
    """t = 0 counts; `offset_origin` is there for rays that must not."""
    geometry = build(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    hits = trace_rays(geometry, np.zeros((1, 3), np.float32), np.array([[0, 0, -1]], np.float32))
    assert int(hits.triangle[0]) == 0 and float(hits.t[0]) == 0 and not np.signbit(hits.t[0])


def test_other_queries_and_shapes_are_refused(rng, build):
    vertices, faces, origins, directions = triangle_soup(rng, 8)
    geometry = build(vertices, faces)
    with pytest.raises(ValueError, match="query: expected one of closest, any, got nearest"):
        trace_rays(geometry, origins, directions, query="nearest")
    with pytest.raises(ValueError, match="origins and directions"):
        trace_rays(geometry, origins, directions[:3])
    with pytest.raises(ValueError, match="max_distance and origins"):
        trace_rays(geometry, origins, directions, max_distance=np.ones(3, np.float32))
