"""Lights, framing and frames of the pictures, on a body small enough to draw in no time."""

import math
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting import pictures
from fitting.pictures import (
    BRIGHT,
    Film,
    builtin_environment,
    exposure_of,
    film_frames,
    frame_vertices,
    key_light,
    light_of,
    make_still,
    pose_at_frames,
    render_clip,
    sweep_frames,
    turn_light,
    without_ringing,
)
from jaxrender.animation.skeleton import Channel, Clip, Pose, Skeleton
from jaxrender.animation.skinning import Character, Skin
from jaxrender.camera import project_px
from jaxrender.checks import InputError
from jaxrender.harmonics import hemisphere_zh, project_environment, rotate_environment, sh_basis
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel
from jaxrender.io.picture import read_png
from jaxrender.latlong import environment_directions
from tests.support.asserts import assert_close
from tests.support.tolerances import LONG_SUM

EPS = np.finfo(np.float32).eps


@pytest.fixture(scope="module")
def body():
    """A ball of radius 1 on one joint, which walks 3 units along x within a second."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    rest = Pose(jnp.zeros((1, 3)), jnp.asarray([[0.0, 0.0, 0.0, 1.0]]), jnp.ones((1, 3)))
    vertices = jnp.asarray(mesh.vertices, jnp.float32)
    v = len(vertices)
    skin = Skin(
        vertices=vertices,
        normals=vertices,
        joint_indices=jnp.zeros((v, 1), jnp.int32),
        weights=jnp.ones((v, 1)),
        palette_joints=jnp.zeros(1, jnp.int32),
        inverse_binds=jnp.eye(4)[None],
    )
    way = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.float32)
    channel = Channel(0, "translation", "LINEAR", np.array([0.0, 1.0], np.float32), way)
    clip = Clip("walk", (channel,), 0.0, 1.0)
    albedo = np.full((v, 3), 0.5, np.float32)
    faces = np.asarray(mesh.faces, np.int32)
    return Character("ball", Skeleton(("root",), (-1,), rest), skin, faces, (clip,), albedo, "0")


@pytest.fixture(scope="module")
def model(body):
    """Unoccluded, whatever the pose: exact for a ball."""
    p = len(body.albedo)
    weights = np.zeros((2, 6, p), np.float32)
    weights[0, 2:] = np.asarray(hemisphere_zh(order=4))[:, None]
    basis = FeatureBasis(
        kind="surroundings",
        size=2.0,
        joints=jnp.zeros(1, jnp.int32),
        bones=jnp.zeros(1, jnp.int32),
        falloff=jnp.ones((1, 1)),
        reference=jnp.asarray([[0.0, 0.0, 0.0, 1.0]]),
        translations=jnp.zeros((1, 3)),
        mean=jnp.zeros((1, 13)),
        basis=jnp.zeros((1, 13, 1)),
    )
    axes = jnp.tile(jnp.asarray([[[0.0, 0.0, 1.0]]]), (p, 1, 1))
    points = jnp.arange(p, dtype=jnp.int32)
    offset, groups = jnp.zeros((p, 16)), jnp.zeros(p, jnp.int32)
    return PoseModel(basis, jnp.asarray(weights), axes, offset, groups, points, jnp.ones(p, bool))


@pytest.fixture(scope="module")
def sky():
    return builtin_environment(height=32)


# --- Light


@pytest.mark.parametrize("columns", [1, 9, -20])
def test_light_turns_as_its_map_does(rng, columns):
    environment = jnp.asarray(rng.uniform(0, 1, (16, 32, 3)), jnp.float32)
    angle = 2 * math.pi * columns / 32
    expected = project_environment(rotate_environment(environment, angle), order=4)
    assert_close(
        turn_light(project_environment(environment, order=4), angle), expected, ulps=LONG_SUM, dtype=np.float32
    )


def test_the_builtin_sky_is_lit_by_its_sun(sky):
    assert np.isfinite(sky).all() and sky.min() > 0 and sky.dtype == np.float32
    directions, _ = environment_directions(*sky.shape[:2])
    row, column = np.unravel_index(np.argmax(sky.sum(axis=-1)), sky.shape[:2])
    sun = directions[row, column]
    assert sun[0] > 0.5 and sun[1] > 0.3  # on the right, above the horizon
    light = np.asarray(project_environment(jnp.asarray(sky), order=4)).sum(axis=0)
    brightest = np.array([-light[3], -light[1], light[2]]) / np.linalg.norm(light[1:4])
    assert brightest @ sun > 0.85
    # Blue above, warm in front of the feet.
    assert sky[2, 0, 2] > 1.5 * sky[2, 0, 0] and sky[-2, 0, 0] > sky[-2, 0, 2]


@pytest.mark.parametrize("source", ["lamp", "sky", "soft"])
def test_windowed_light_hardly_rings(source, sky):
    light = {
        "lamp": key_light((0.3, 0.8, -0.2), ambient=(0.2, 0.2, 0.2)),
        "sky": light_of(sky),
        "soft": without_ringing(jnp.zeros((3, 16)).at[:, 0].set(2.0).at[:, 2].set(0.5)),
    }[source]
    directions, _ = environment_directions(40, 80)
    radiance = np.asarray(sh_basis(jnp.asarray(directions.reshape(-1, 3), jnp.float32), order=4) @ light.T)
    luminance = radiance @ np.float32([0.2126, 0.7152, 0.0722])
    # 5 % of the mean, as promised on a coarser grid of directions than this one.
    assert luminance.min() > -0.06 * luminance.mean()
    if source == "soft":  # it does not ring: nothing worth a name is taken away
        np.testing.assert_allclose(np.asarray(light)[:, [0, 2]], [[2.0, 0.5]] * 3, rtol=0.01)


def test_a_key_light_comes_from_its_direction():
    light = np.asarray(key_light((3.0, 0.0, 4.0), irradiance=(2.0, 1.0, 0.5)))
    towards = np.stack([-light[:, 3], -light[:, 1], light[:, 2]], axis=-1)
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(towards, [[0.6, 0.0, 0.8]] * 3, atol=16 * EPS)


def test_exposure_brings_the_bright_part_to_its_level():
    colors = np.full((10, 3), 0.2, np.float32)
    assert exposure_of([colors]) == pytest.approx(math.log2(BRIGHT / 0.2))
    half_hidden = np.concatenate([colors, np.zeros((30, 3), np.float32)])
    assert exposure_of([half_hidden]) == pytest.approx(math.log2(BRIGHT / 0.2))
    assert exposure_of([colors, 4 * colors]) == pytest.approx(math.log2(BRIGHT / 0.4))
    assert math.isfinite(exposure_of([np.zeros((4, 3), np.float32)]))


# --- Framing


@pytest.mark.parametrize("aspect", [0.6, 1.0, 1.7])
@pytest.mark.parametrize("angles", [(0.0, 0.0), (25.0, 10.0), (200.0, 60.0)])
def test_all_vertices_are_in_view_and_fill_it(rng, aspect, angles):
    vertices = rng.normal(size=(200, 3)) * [0.4, 1.0, 0.3] + [50.0, -3.0, 7.0]
    camera = frame_vertices(
        vertices, azimuth_degrees=angles[0], elevation_degrees=angles[1], aspect=aspect, margin=0.1
    )  # fmt: skip
    width, height = 1000 * aspect, 1000
    px, depth = project_px(camera, jnp.asarray(vertices, jnp.float32), height=height, width=int(width))
    share = (np.asarray(px) - [width / 2, height / 2]) / [width / 2, height / 2]
    assert (np.asarray(depth) > 0).all()
    # One axis is full up to the margin; on both the vertices are centred (float32 positions at 50: 1e-4 of a picture).
    low, high = share.min(axis=0), share.max(axis=0)
    np.testing.assert_allclose(np.maximum(-low, high).max(), 1 / 1.1, atol=2e-3)
    np.testing.assert_allclose(low + high, 0.0, atol=0.01)


# --- Frames


def test_the_exponent_sweeps_there_and_back():
    film = Film(exponents=(1.0, 63.0))
    assert [film.exponent(phase) for phase in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 63.0, 1.0])
    assert [film.exponent(phase) for phase in (0.25, 0.75)] == pytest.approx([math.sqrt(2 * 64) - 1] * 2)
    assert Film(exponents=(5.0,)).exponent(0.3) == pytest.approx(5.0)


def test_a_film_shows_the_whole_way_under_a_turning_sky(body, model, sky):
    poses = pose_at_frames(body, 0, fps=3.0)
    linear = {}
    film = Film(size=(40, 24), azimuth_degrees=0.0, elevation_degrees=0.0)
    frames = list(film_frames(body, model, poses, sky, film, each=linear.__setitem__))
    assert len(frames) == 4 and sorted(linear) == [0, 1, 2, 3]
    for frame in frames:
        assert frame.shape == (24, 40, 3) and np.isfinite(frame).all() and frame.min() >= 0 and frame.max() <= 1
    camera = pictures._film_camera(body, poses, film)
    left = pictures.visible_surface(*_posed(body, poses, 0), camera, height=24, width=40)
    right = pictures.visible_surface(*_posed(body, poses, 3), camera, height=24, width=40)
    columns = [np.flatnonzero((s.triangle_id >= 0).any(axis=(0, 2))) for s in (left, right)]
    assert 0 < columns[0].min() and columns[0].max() < 20 < columns[1].min() and columns[1].max() < 39
    # The sky behind turns: what is nobody's pixel changes.
    assert np.abs(linear[0][:6] - linear[2][:6]).max() > 0.01


def _posed(body, poses, index):
    mesh = pictures.posed_mesh(body, pictures.pose_at(poses, index))
    return np.asarray(mesh.positions), body.faces


def test_a_film_beside_truth_has_both(body, model, sky):
    poses = pose_at_frames(body, 0, fps=1.0)
    film = Film(size=(32, 24), exponents=(1.0,), truth=True)
    frame = next(iter(film_frames(body, model, poses, sky, film)))
    assert frame.dtype == np.uint8 and frame.shape[1] > 64


def test_a_sweep_sees_its_pose_once(body, model, sky, monkeypatch):
    calls = []
    see = pictures.visible_surface
    monkeypatch.setattr(pictures, "visible_surface", lambda *a, **k: calls.append(1) or see(*a, **k))
    pose = pictures.pose_at(pose_at_frames(body, 0, fps=1.0), 0)
    frames = list(sweep_frames(body, model, pose, sky, Film(size=(24, 24), membrane=True), num_frames=3))
    assert len(frames) == 3 and len(calls) == 1
    middle = [frame[12, 12] for frame in frames]
    assert np.abs(middle[0] - middle[1]).max() > 0.01  # the light has moved


def test_a_still_compares_four_pictures_of_one_size(body, model, tmp_path):
    pose = pictures.pose_at(pose_at_frames(body, 0, fps=1.0), 0)
    still = make_still(body, model, pose, size=64, num_directions=256)
    image = read_png(still.comparison(tmp_path / "a.png", "diffuse", key_light((-1.0, 0.3, 0.2))))
    width = still.surface.triangle_id.shape[1]
    panels = [image[:, 8 + i * (width + 8) :][:, :width] for i in range(4)]
    assert image.shape[1] == 4 * (width + 8) + 8
    # Nothing shadows a ball: the first three are alike, up to the model's cut to four bands.
    body_rows = slice(len(image) - 8 - 44, len(image) - 8 - 20)
    for panel in panels[1:3]:
        assert np.abs(panel[body_rows] - panels[0][body_rows]).mean() < 0.02
    # Seen from the right front, a lamp on the far left lights the left side.
    left, right = panels[1][body_rows, width // 5 : width // 2], panels[1][body_rows, width // 2 : -width // 5]
    assert left.mean() > 1.5 * right.mean()


def test_errors_are_painted_from_two_sides(body, model, tmp_path):
    pose = pictures.pose_at(pose_at_frames(body, 0, fps=1.0), 0)
    still = make_still(body, model, pose, size=48, num_directions=0)
    errors = np.where(np.asarray(body.skin.vertices)[:, 2] > 0, 0.5, np.nan)
    image = read_png(still.painted(tmp_path / "b.png", errors))
    half = image.shape[1] // 2
    # The front half is at the top of the scale, pale yellow; behind there is only its rim.
    assert (image[:, :half, 1] > 0.8).sum() > 10 * (image[:, half:, 1] > 0.8).sum()


# --- The command


def options(tmp_path: Path, **changes):
    film = {name: getattr(Film(), name) for name in Film.__dataclass_fields__}
    given = {"out": tmp_path, "clip": None, "environment": None, "fps": 1.0, "exr": False}
    return SimpleNamespace(**{**film, **given, "size": (24, 24), **changes})


def test_render_clip_writes_frames_and_film(body, model, tmp_path):
    paths = render_clip(body, model, options(tmp_path, exr=True))
    assert all(path.is_file() for path in paths)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["film.webp", *(f"frame_000{i}.{end}" for i in (0, 1) for end in ("exr", "png"))]


def test_an_unknown_clip_is_refused_by_name(body, model, tmp_path):
    with pytest.raises(InputError, match=r"clip: expected one of walk, got jump"):
        render_clip(body, model, options(tmp_path, clip="jump"))
