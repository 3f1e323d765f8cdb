"""The main job on small data: training, resuming, model files, mesh sequences, bad input."""

import dataclasses
import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from safetensors.numpy import load_file

from fitting.cli import main
from fitting.config import BakeSettings, FitSettings, SplitSettings, TrainSettings
from fitting.dataset import VisibilityStore, character_frames, choose_points, represent_by_visible
from fitting.features import all_raw_features, unfitted_basis
from fitting.fit import predict_sh
from fitting.model import MODEL_FILE, find_model, model_header, save_pose_model, to_half
from fitting.motion import CLIP, MIXED, SEGMENT, TRAIN, articulating_joints, limb_starts, sample_motion
from fitting.train import train_character, train_sequence
from fitting.training_data import bake_character
from jaxrender.animation.mannequin import builtin_character
from jaxrender.animation.skeleton import Clip
from jaxrender.checks import InputError
from jaxrender.harmonics import VisibilityCaster, hemisphere_directions, project_features
from jaxrender.scene import make_mesh_sequence

SMALL = TrainSettings(
    BakeSettings(max_frames=36, num_mixed=8, num_directions=64, max_points=60),
    SplitSettings(),
    FitSettings(num_components=8, refine_steps=6),
)


@pytest.fixture(scope="module")
def character():
    return builtin_character(num_vertices=2000)


@pytest.fixture(scope="module")
def trained(character, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return train_character(character, SMALL, folder), folder


def one_hinge(clip, joints):
    """The keys of one joint's rotation, turned about one axis only."""
    channel = next(c for c in clip.channels if c.path == "rotation" and c.joint in joints)
    times = np.linspace(0.0, 1.0, 5)
    half = 0.4 * np.sin(4.0 * times)
    zero = np.zeros_like(times)
    turns = np.stack([np.sin(half), zero, zero, np.cos(half)], axis=-1)
    return (dataclasses.replace(channel, interpolation="LINEAR", times=times, values=turns),)


def bvh_of(elbow):
    """An arm of three bones of which only the elbow turns, by these angles."""
    bones = [("Shoulder", "0 0 0"), ("Elbow", "30 0 0"), ("Wrist", "25 0 0")]
    text = "HIERARCHY\n"
    for number, (name, offset) in enumerate(bones):
        channels = "CHANNELS 3 Zrotation Xrotation Yrotation"
        text += f"{'ROOT' if number == 0 else 'JOINT'} {name}\n{{\nOFFSET {offset}\n{channels}\n"
    text += "End Site\n{\nOFFSET 10 0 0\n}\n" + "}\n" * len(bones)
    rows = "\n".join(f"0 0 0 {angle} 0 0 0 0 0" for angle in elbow)
    return text + f"MOTION\nFrames: {len(elbow)}\nFrame Time: 0.033333\n{rows}\n"


def header_of(result):
    source = {"name": "n", "content_hash": "h", "input": None, "num_vertices": 2000}
    return json.loads(json.dumps(model_header(result, SMALL, source=source, errors={})))


def global_error(result, part):
    data = result.data
    visible = np.flatnonzero(data.visible)
    components = np.asarray(project_features(result.model.features, jnp.asarray(data.raw)))
    frames = data.part == part
    predicted, baked = predict_sh(result.model, components, visible)[frames], data.sh(visible)[frames]
    return np.sqrt(((predicted - baked) ** 2).sum() / (baked**2).sum())


def mean_error(result, part):
    data = result.data
    baked = data.sh(np.flatnonzero(data.visible))
    mean = baked[data.part == TRAIN].mean(axis=0)
    return np.sqrt(((mean - baked[data.part == part]) ** 2).sum() / (baked[data.part == part] ** 2).sum())


def test_a_model_beats_the_mean_on_training_and_on_held_out_frames(trained):
    result, _ = trained
    for part, share in ((TRAIN, 0.6), (SEGMENT, 0.9)):
        assert global_error(result, part) < share * mean_error(result, part)


def test_refinement_lowers_the_training_error(trained, character, tmp_path):
    result, folder = trained
    plain = dataclasses.replace(SMALL, fit=dataclasses.replace(SMALL.fit, refine_steps=0, ridge=result.ridge))
    linear = train_character(character, plain, folder)
    assert linear.bake.frames_done_before == len(linear.data.part)  # nothing is traced twice
    assert global_error(result, TRAIN) < global_error(linear, TRAIN)


def test_an_interrupted_bake_continues_and_ends_with_the_same_bits(trained, character, tmp_path):
    result, _ = trained

    class Stop(Exception):
        pass

    def stop_after_seven(items, _count, label, _done):
        for number, item in enumerate(items):
            if label == "bake" and number == 7:
                raise Stop
            yield item

    with pytest.raises(Stop):
        train_character(character, SMALL, tmp_path, track=stop_after_seven)
    data, statistics, _ = bake_character(character, SMALL, tmp_path / "bake.zarr")
    assert statistics.frames_done_before == 7
    np.testing.assert_array_equal(data.bits, result.data.bits)


def test_either_ray_backend_bakes_the_same_bits(trained, character):
    """The mannequin in three frames, the tree refitted between them; rays that graze an edge may differ."""
    data = trained[0].data
    motion = sample_motion(character, SMALL.bake, SMALL.split)
    frame, directions = character_frames(character, motion), hemisphere_directions(SMALL.bake.num_directions)
    caster = VisibilityCaster(np.asarray(character.faces), directions, points=data.points.vertices, rays="jax")
    for index in (0, 5, 20):
        different = np.bitwise_count(caster.cast(*frame(index)) ^ data.bits[index]).sum()
        assert different <= 1e-3 * data.bits[index].size * 8


def test_frames_that_are_damaged_on_disk_are_baked_again(trained, character, tmp_path):
    result, folder = trained
    shutil.copytree(folder / "bake.zarr", tmp_path / "bake.zarr")
    chunks = sorted((tmp_path / "bake.zarr" / "visibility" / "c").iterdir(), key=lambda p: int(p.name))
    lost, cut = next(chunks[3].rglob("0")), next(p for p in chunks[5].rglob("0") if p.is_file())
    shutil.rmtree(lost) if lost.is_dir() else lost.unlink()
    cut.write_bytes(cut.read_bytes()[:-9])
    data, statistics, _ = bake_character(character, SMALL, tmp_path / "bake.zarr")
    assert statistics.frames_done_before == len(data.part) - 2
    np.testing.assert_array_equal(data.bits, result.data.bits)


def test_no_visible_vertex_is_left_to_a_point_that_sees_nothing(trained, character):
    visible = np.arange(60) % 3 > 0
    points = represent_by_visible(character, trained[0].data.points, visible)
    others = np.setdiff1d(np.arange(len(points.of_vertex)), points.vertices)
    assert visible[points.of_vertex[others]].all()
    np.testing.assert_array_equal(points.of_vertex[points.vertices], np.arange(len(visible)))


def test_a_store_of_other_contents_and_a_foreign_folder_are_refused(tmp_path):
    bake = BakeSettings(num_directions=64)
    store = VisibilityStore(tmp_path / "s", num_frames=2, num_points=3, bake=bake, source="a")
    store.write(0, np.zeros((3, 8), np.uint8))
    assert list(VisibilityStore(tmp_path / "s", num_frames=2, num_points=3, bake=bake, source="a").missing()) == [1]
    with pytest.raises(InputError, match="source: expected a, as it was baked, got b; take another -o, or delete"):
        VisibilityStore(tmp_path / "s", num_frames=2, num_points=3, bake=bake, source="b")
    assert list(VisibilityStore(tmp_path / "s", num_frames=2, num_points=3, bake=bake, source="a").missing()) == [1]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="something else"):
        VisibilityStore(tmp_path / "foreign", num_frames=2, num_points=3, bake=bake, source="a")
    assert (tmp_path / "foreign" / "thesis.txt").read_text() == "mine"


def test_a_model_file_keeps_everything(trained, tmp_path):
    result, _ = trained
    header = header_of(result) | {"note": 'text with "quotes"'}
    save_pose_model(tmp_path / MODEL_FILE, result.model, header)
    loaded, read, _ = find_model(tmp_path)
    assert read == header
    jax.tree.map(np.testing.assert_array_equal, loaded, result.model)
    save_pose_model(tmp_path / "half.safetensors", to_half(result.model), header)
    half, _, _ = find_model(tmp_path / "half.safetensors")
    assert load_file(tmp_path / "half.safetensors")["weights"].dtype == np.float16
    rounded = dataclasses.replace(result, model=half)
    assert global_error(rounded, TRAIN) == pytest.approx(
        global_error(result, TRAIN), rel=2e-3
    )  # float16: 5e-4 a number


def test_the_split_holds_out_the_end_of_clips_and_whole_clips(character):
    held = character.clips[1].name
    motion = sample_motion(character, SMALL.bake, SplitSettings(clips=(held,)))
    assert set(motion.part[motion.clip == 1]) == {CLIP}
    for clip in (0, 2):
        part = motion.part[motion.clip == clip]
        assert (np.diff(part) >= 0).all() and 0 < (part == SEGMENT).mean() <= 0.2
    assert (motion.part == MIXED).sum() == SMALL.bake.num_mixed
    with pytest.raises(InputError, match="no such clip"):
        sample_motion(character, SMALL.bake, SplitSettings(clips=("swim",)))


def test_mixed_poses_take_whole_limbs_from_training_frames(character):
    motion = sample_motion(character, SMALL.bake, SMALL.split)
    rotations = np.asarray(motion.pose.rotation)
    source, mixed = rotations[motion.where(TRAIN)], rotations[motion.where(MIXED)]
    starts = limb_starts(character)
    for joint, parent in enumerate(character.skeleton.parents):
        own = np.abs(mixed[:, None, joint] - source[None, :, joint]).max(axis=-1) < 1e-6
        assert own.any(axis=1).all()
        if parent >= 0 and joint not in starts:  # the same frame as the parent's
            above = np.abs(mixed[:, None, parent] - source[None, :, parent]).max(axis=-1) < 1e-6
            assert (own & above).any(axis=1).all()


def test_features_do_not_see_where_the_body_stands(character):
    motion = sample_motion(character, SMALL.bake, SMALL.split)
    root = set(range(len(character.skeleton.parents))) - set(articulating_joints(character))
    turned = np.asarray(motion.pose.translation).copy()
    turned[:, sorted(root)] += np.array([3.0, -1.0, 2.0])
    moved = dataclasses.replace(motion, pose=dataclasses.replace(motion.pose, translation=turned))
    basis = unfitted_basis(character, motion, "surroundings", np.array([3], np.int32))
    one, two = (all_raw_features(basis, character, m)[:6] for m in (motion, moved))
    np.testing.assert_allclose(one, two, atol=2e-5)  # float32 at 4 m: 5e-7, divided by lengths of 0.1


def test_points_stand_for_their_vertices(character):
    points = choose_points(character, 100)
    assert len(points.vertices) == 100 and points.of_vertex.max() == 99
    at = np.asarray(character.skin.vertices)
    distance = np.linalg.norm(at - at[points.vertices[points.of_vertex]], axis=1)
    assert np.median(distance) < 0.1 and distance.max() < 0.5
    np.testing.assert_array_equal(points.of_vertex[points.vertices], np.arange(100))


def test_a_mesh_sequence_trains_from_bare_arrays(tmp_path):
    # A plate that bends over a ball: visibility follows one feature.
    ball = trimesh.creation.icosphere(2, radius=0.4)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 8)), -1).reshape(-1, 2)
    cells = [(r * 8 + c, r * 8 + c + 1, r * 8 + c + 9, r * 8 + c + 8) for r in range(7) for c in range(7)]
    plate_faces = np.array([t for a, b, c, d in cells for t in ((a, b, c), (a, c, d))])
    faces = np.concatenate([ball.faces, plate_faces + len(ball.vertices)])
    bend = np.sin(np.linspace(0, 6, 30))
    plates = np.stack([np.concatenate([grid, (b * grid[:, :1] ** 2 + 1.0)], axis=1)[:, [0, 2, 1]] for b in bend])
    vertices = np.concatenate([np.broadcast_to(ball.vertices, (30, *ball.vertices.shape)), plates], axis=1)
    sequence = make_mesh_sequence(
        jnp.asarray(vertices, jnp.float32), jnp.asarray(faces), jnp.asarray(np.stack([bend, bend**2], 1), jnp.float32)
    )
    result = train_sequence(sequence, SMALL, tmp_path)
    for part in (TRAIN, SEGMENT):
        assert global_error(result, part) < 0.5 * mean_error(result, part)
    constant = dataclasses.replace(sequence, features=jnp.ones((30, 2)))
    with pytest.raises(InputError, match="varies"):
        train_sequence(constant, SMALL, tmp_path)
    holed = np.array(sequence.vertices)
    holed[3, 2, 1] = np.nan
    broken = dataclasses.replace(sequence, vertices=holed)
    with pytest.raises(InputError, match="vertices"):
        train_sequence(broken, SMALL, tmp_path / "nan")


def test_bad_characters_are_refused_in_one_line(character, tmp_path):
    still = dataclasses.replace(character, clips=())
    with pytest.raises(InputError, match="at least one clip"):
        train_character(still, SMALL, tmp_path)
    one_frame = dataclasses.replace(character, clips=(Clip("pose", (), 0.0, 0.0),))
    with pytest.raises(InputError, match="training frames"):
        train_character(one_frame, SMALL, tmp_path)
    frozen = dataclasses.replace(character, clips=(Clip("frozen", (), 0.0, 1.0),))
    with pytest.raises(InputError, match="active joints"):
        train_character(frozen, SMALL, tmp_path)
    # One channel of one joint: the matrix of joint angles has rank 1.
    keys = one_hinge(character.clips[0], articulating_joints(character))
    hinge = dataclasses.replace(character, clips=(Clip("hinge", keys, 0.0, 1.0),))
    with pytest.raises(InputError, match="joint angles of rank 2 or more over the frames, got rank 1"):
        train_character(hinge, SMALL, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "nowhere.glb", "-o", "OUT"], "nowhere.glb"),
        (["train", "TRUNCATED", "-o", "OUT"], "TRUNCATED"),
        (["inspect", "EMPTY"], "model.safetensors"),
        (["inspect", "TRUNCATED"], "safetensors"),
        (["train", "--fit.num-lobes", "7", "-o", "OUT"], "num_lobes"),
        (["train", "-o", "FILE/below"], "FILE"),
        (["train", "EMPTY", "-o", "OUT"], "EMPTY: input: expected a glTF, GLB or BVH file, got a folder"),
        (["train", "STILL", "-o", "OUT"], "still.bvh: training frames: expected at least 2"),
        (["train", "HINGE", "-o", "OUT"], "hinge.bvh: poses: expected joint angles of rank 2 or more"),
    ],
)
def test_bad_arguments_end_with_one_line_and_status_2(arguments, words, tmp_path, capsys):
    (tmp_path / "EMPTY").mkdir()
    (tmp_path / "FILE").write_text("a file")
    (tmp_path / "TRUNCATED").write_bytes(b"glTF\x02\x00\x00\x00")
    places = {name: str(tmp_path / name) for name in ("OUT", "EMPTY", "TRUNCATED", "FILE/below")}
    places |= {"STILL": str(tmp_path / "still.bvh"), "HINGE": str(tmp_path / "hinge.bvh")}
    (tmp_path / "still.bvh").write_text(bvh_of([0.0]))
    (tmp_path / "hinge.bvh").write_text(bvh_of([0.0, 5.0, 20.0, 40.0, 30.0, 10.0, -10.0]))
    assert main([places.get(word, word) for word in arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert words in "".join(lines) and "Traceback" not in "".join(lines)
    assert not (tmp_path / "OUT").exists()


def test_inspect_prints_json(trained, tmp_path, capsys):
    result, _ = trained
    header = header_of(result)
    save_pose_model(tmp_path / MODEL_FILE, result.model, header)
    assert main(["inspect", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["header"] == header


def test_importing_fitting_keeps_xla_to_one_thread():
    code = "import fitting, os; print(os.environ['XLA_FLAGS'])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "xla_cpu_multi_thread_eigen=false" in out
