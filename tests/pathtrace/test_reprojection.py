"""Where surfaces were in the frame before: points that move with their triangles, and what is not seen there."""

import dataclasses

import numpy as np

from jaxrender.camera import Camera, project_px
from jaxrender.pathtrace import move, prepare
from jaxrender.pathtrace.guide_rays import trace_guides
from jaxrender.pathtrace.reprojection import previous_places
from tests.pathtrace.test_render import ABOVE, PLAIN, SIZE, camera, floor
from tests.support.rooms import matt, room, sphere

SHARP = dataclasses.replace(PLAIN, bounces=0)


def scene_at(x: float):
    """A ball above a floor."""
    ball = sphere(matt((0.7, 0.3, 0.2)), radius=0.4)
    return room(floor(), (ball[0] + np.array([x, 0.5, 0.0]), *ball[1:]))


def found(before, camera_before: Camera, now, camera_now: Camera):
    world = prepare(before)
    seen = trace_guides(world, camera_before, settings=SHARP, **SIZE)
    moved = move(world, now)
    places, matches = previous_places(moved, camera_now, before, camera_before, seen)
    return places, matches, seen, trace_guides(moved, camera_now, settings=SHARP, **SIZE)


def test_nothing_moves():
    """Every surface is where it was, but for edges, where other surfaces are around."""
    scene = scene_at(0.0)
    places, matches, seen, _ = found(scene, ABOVE, scene, ABOVE)
    height, width = SIZE["height"], SIZE["width"]
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    np.testing.assert_allclose(places[matches], np.stack([x, y], axis=-1)[matches], rtol=0, atol=2e-3)
    covered = seen.depth[..., 0] > 0.0
    assert not matches[~covered].any() and matches.sum() > 0.6 * covered.sum()


def test_points_move_with_their_triangles():
    """The ball has moved, and so has the camera: floor and ball are followed each by itself."""
    aside = camera((0.3, 3.0, 2.4), (0.1, 0.0, 0.0))
    places, matches, _, now = found(scene_at(0.0), ABOVE, scene_at(0.25), aside)
    was = np.array(now.position)
    ball = now.position[..., 1] > 1e-3
    was[ball] -= [0.25, 0.0, 0.0]
    truth, _ = project_px(ABOVE, was, **SIZE)
    np.testing.assert_allclose(places[matches], np.asarray(truth)[matches], rtol=0, atol=5e-3)
    assert (matches & ball).any() and (matches & ~ball).any()


def test_what_was_hidden_does_not_match():
    """Where the ball stood, the floor behind it had not been seen."""
    _, matches, before, now = found(scene_at(0.0), ABOVE, scene_at(9.0), ABOVE)
    behind = (before.position[..., 1] > 1e-3) & (now.depth[..., 0] > 0.0)
    assert behind.sum() > 5 and not matches[behind].any()
