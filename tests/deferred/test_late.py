"""Late depth tests: discards, coverage and depth that a shader writes, against one picture of each triangle."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import (
    CENTER,
    alpha_to_coverage,
    draw_late,
    ordered_grid,
    rasterize_triangles,
    screen_triangles,
    standard_pattern,
)
from jaxrender.deferred import late as late_module

SIZE = {"height": 40, "width": 52}
FIELDS = ("triangle_id", "screen_id", "barycentrics", "depth", "w")


def soup(rng, n):
    """Triangles all over the image and beyond it, some of them behind the eye in part, and copies that tie in depth."""
    w = rng.uniform(0.2, 3.0, (n, 3, 1))
    xyz = rng.uniform(-1.4, 1.4, (n, 3, 3)) * w
    xyz[..., 2] = rng.uniform(0.0, 1.0, (n, 3)) * w[..., 0]
    clip = np.concatenate([xyz, w], axis=-1)
    clip[::7, 0, 3] *= -0.3
    clip[3::9] = clip[2::9][: len(clip[3::9])]
    return jnp.asarray(clip.reshape(-1, 4), jnp.float32), jnp.asarray(np.arange(3 * n).reshape(n, 3), jnp.int32)


def only(triangles, chosen):
    return dataclasses.replace(triangles, valid=triangles.valid & jnp.asarray(chosen)[triangles.source])


def hashed(place, triangle):
    """A discard that looks random and depends on place and triangle alone."""
    return (place * 7919 + triangle * 104729) % 13 < 7


@jax.jit
def hashed_shader(late):
    return hashed(late.place, late.triangle_id), late.depth


def one_by_one(triangles, faces, early, keep, samples):
    """The rule itself: every triangle's own picture, discards applied, nearest wins, the first of equals."""
    best = None
    for t in range(len(faces)):
        alone = rasterize_triangles(only(triangles, np.arange(len(faces)) == t), faces, **SIZE, samples=samples)
        fields = {name: np.asarray(getattr(alone, name)) for name in FIELDS}
        place = np.arange(fields["depth"].size, dtype=np.int32).reshape(fields["depth"].shape)
        seen = (fields["triangle_id"] >= 0) & (early[t] | keep(place, fields["triangle_id"]))
        if best is None:
            best = {name: np.full_like(values, -1 if name.endswith("id") else 0) for name, values in fields.items()}
            best["depth"][:] = 1.0
            best["full"] = np.zeros(seen.shape, bool)
        wins = seen & ((fields["depth"] < best["depth"]) | ~best["full"])
        for name in FIELDS:
            best[name][wins] = fields[name][wins]
        best["full"] |= wins
    return best


@pytest.mark.parametrize("samples", [CENTER, ordered_grid(3), standard_pattern(4), standard_pattern(16)])
def test_discards_are_those_of_drawing_one_by_one(samples, rng):
    clip, faces = soup(rng, 24)
    triangles = screen_triangles(clip, faces, **SIZE, samples=samples)
    early = rng.uniform(size=len(faces)) < 0.5
    drawn = rasterize_triangles(only(triangles, early), faces, **SIZE, samples=samples)
    got = draw_late(drawn, only(triangles, ~early), hashed_shader)
    expected = one_by_one(triangles, faces, early, hashed, samples)
    assert 0.3 < expected["full"].mean() < 1.0
    for name in FIELDS:
        np.testing.assert_array_equal(np.asarray(getattr(got, name)), expected[name], err_msg=name)


def test_blocks_and_pieces_do_not_show(rng, monkeypatch):
    """More fragments and pairs than fit in one look."""
    clip, faces = soup(rng, 60)
    triangles = screen_triangles(clip, faces, **SIZE)
    drawn = rasterize_triangles(only(triangles, np.zeros(len(faces), bool)), faces, **SIZE)
    whole = draw_late(drawn, triangles, hashed_shader)
    monkeypatch.setattr(late_module, "_PAIRS_PER_CHUNK", 32)
    monkeypatch.setattr(late_module, "_FRAGMENTS_PER_BLOCK", 1000)
    pieces = draw_late(drawn, triangles, hashed_shader)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)


def test_a_shader_that_keeps_all_or_nothing(rng):
    clip, faces = soup(rng, 30)
    triangles = screen_triangles(clip, faces, **SIZE)
    early = np.arange(len(faces)) < 10
    drawn = rasterize_triangles(only(triangles, early), faces, **SIZE)
    rest = only(triangles, ~early)
    none = draw_late(drawn, rest, lambda late: (jnp.zeros(late.place.shape, bool), late.depth))
    everything = draw_late(drawn, rest, lambda late: (jnp.ones(late.place.shape, bool), late.depth))
    at_once = rasterize_triangles(triangles, faces, **SIZE)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(none, name), getattr(drawn, name))
        np.testing.assert_array_equal(getattr(everything, name), getattr(at_once, name))


def test_written_depth_decides(rng):
    """A depth that runs backwards shows the last of all covering triangles; one beyond the far plane shows nothing."""
    clip, faces = soup(rng, 30)
    triangles = screen_triangles(clip, faces, **SIZE)
    nothing = rasterize_triangles(only(triangles, np.zeros(len(faces), bool)), faces, **SIZE)
    backwards = draw_late(nothing, triangles, lambda late: (late.triangle_id >= 0, 1.0 - late.depth))
    pictures = [
        rasterize_triangles(only(triangles, np.arange(len(faces)) == t), faces, **SIZE) for t in range(len(faces))
    ]
    deepest = np.max([np.where(np.asarray(p.coverage), np.asarray(p.depth), -1.0) for p in pictures], axis=0)
    np.testing.assert_array_equal(np.asarray(backwards.coverage), deepest >= 0)
    np.testing.assert_array_equal(
        np.asarray(backwards.depth)[deepest >= 0], (np.float32(1.0) - deepest.astype(np.float32))[deepest >= 0]
    )
    gone = draw_late(nothing, triangles, lambda late: (late.triangle_id >= 0, late.depth + 2.0))
    assert not bool(gone.coverage.any())


def test_no_pixels_and_no_triangles():
    clip, faces = jnp.zeros((3, 4), jnp.float32), jnp.asarray([[0, 1, 2]], jnp.int32)
    triangles = screen_triangles(clip, faces, height=0, width=5)
    empty = rasterize_triangles(triangles, faces, height=0, width=5)
    assert draw_late(empty, triangles, hashed_shader).triangle_id.shape == (0, 5, 1)
    triangles = screen_triangles(clip, faces, height=4, width=5)
    drawn = rasterize_triangles(triangles, faces, height=4, width=5)
    assert not bool(draw_late(drawn, triangles, hashed_shader).coverage.any())


@pytest.mark.parametrize("count", [1, 4, 8, 9, 16])
def test_alpha_becomes_a_share_of_the_samples(count):
    """Over 4 x 4 pixels the share is alpha to 1/(16·count), and samples come one by one as alpha grows."""
    place = jnp.arange(16 * count, dtype=jnp.int32)
    previous = np.zeros(16 * count, bool)
    for alpha in np.linspace(0.0, 1.0, 33):
        kept = np.asarray(
            alpha_to_coverage(jnp.full(16 * count, alpha, jnp.float32), place, num_samples=count, width=4)
        )
        assert (
            abs(kept.mean() - alpha) <= 0.5 / 16 + 1e-6
            if count == 1
            else abs(kept.mean() - alpha) <= 1 / 16 / count * 8
        )
        assert (kept | ~previous).all()
        previous = kept
    assert kept.all()


def test_coverage_is_spread_over_the_samples_of_a_pixel():
    """At one half, of 16 samples in a row or column of four each has two, not four and none."""
    place = jnp.arange(16, dtype=jnp.int32)
    keep = functools.partial(alpha_to_coverage, place=place, num_samples=16, width=1)
    kept = np.asarray(keep(jnp.full(16, 0.5, jnp.float32))).reshape(4, 4)
    assert kept.sum() == 8 and (kept.sum(axis=0) <= 3).all() and (kept.sum(axis=1) <= 3).all()
