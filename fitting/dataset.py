"""What a model is trained on: shading points, poses and their baked visibility, in a resumable store on disk.

The store is a zarr group with one chunk per frame. A frame is written whole, then its checksum; an interrupted bake
continues with the frames whose checksum is missing or wrong and ends with the same bytes. zarr writes a chunk to a
temporary file and renames it, but does not bring it to the disk first: after a power cut, the checksum tells.
"""

import contextlib
import json
import os
import secrets
import shutil
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import zarr
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from fitting.checkpoint import first_difference
from fitting.config import BakeSettings
from fitting.lock import only_writer
from fitting.motion import Motion
from fitting.stages import Track, no_tracking
from jaxrender.animation.skeleton import global_matrices
from jaxrender.animation.skinning import Character, skin_mesh
from jaxrender.checks import bad_input, check_finite
from jaxrender.console import to_jsonable
from jaxrender.harmonics.visibility import VisibilityCaster, hemisphere_directions
from jaxrender.scene import MeshSequence

STORE_VERSION = 2


@dataclass(frozen=True)
class ShadingPoints:
    """The vertices that are traced, and for every mesh vertex the point that stands for it."""

    vertices: Int[np.ndarray, " p"]
    of_vertex: Int[np.ndarray, " v"]


def choose_points(character: Character, max_points: int, *, seed: int = 0) -> ShadingPoints:
    """One point for all vertices that move and are lit alike (texture seams, doubled corners).

    With `max_points` a subset, drawn with the area around each vertex as its weight; every other vertex takes the
    nearest point of its neighbourhood and orientation.
    """
    skin = character.skin
    parts = (skin.vertices, skin.normals, skin.joint_indices, skin.weights)
    rows = np.concatenate([np.asarray(part, np.float32).reshape(len(skin.vertices), -1) for part in parts], axis=1)
    _, first, of_vertex = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    points = ShadingPoints(first, of_vertex.reshape(-1))
    if max_points == 0 or len(first) <= max_points:
        return points
    at = np.asarray(skin.vertices, np.float64)
    corners = at[character.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    share = np.bincount(of_vertex.reshape(-1)[character.faces.reshape(-1)], np.repeat(area, 3), len(first)) + 1e-12
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(len(first), max_points, replace=False, p=share / share.sum()))
    return ShadingPoints(first[kept], nearest_points(character, first[kept]))


def nearest_points(character: Character, vertices: Int[np.ndarray, " n"]) -> Int[np.ndarray, " v"]:
    """For every vertex which of some vertices is most like it: near, of like normal, and moved by the same joints."""
    skin = character.skin
    at, normals = np.asarray(skin.vertices, np.float64), np.asarray(skin.normals, np.float64)
    joints = np.zeros((len(at), len(character.skeleton.parents)))
    palette = np.asarray(skin.palette_joints)[np.asarray(skin.joint_indices)]
    np.add.at(joints, (np.arange(len(at))[:, None], palette), np.asarray(skin.weights, np.float64))
    size = np.ptp(at, axis=0).max() or 1.0
    key = np.concatenate([at / size, 0.05 * normals, 0.05 * joints], axis=1)
    return cKDTree(key[vertices]).query(key)[1]


def represent_by_visible(character: Character, points: ShadingPoints, visible: Bool[np.ndarray, " p"]) -> ShadingPoints:
    """No vertex is left to a point that sees nothing, unless it is that point itself."""
    seen = np.flatnonzero(visible)
    nearest = seen[nearest_points(character, points.vertices[seen])]
    chosen = np.where(visible[points.of_vertex], points.of_vertex, nearest)
    chosen[points.vertices] = np.arange(len(points.vertices))
    return ShadingPoints(points.vertices, chosen)


PosedMesh = tuple[np.ndarray, np.ndarray]


def character_frames(character: Character, motion: Motion) -> Callable[[int], PosedMesh]:
    """Frame number -> world positions (v, 3) and vertex frames (v, 3, 3)."""

    @jax.jit
    def posed(pose):
        mesh = skin_mesh(character.skin, global_matrices(pose, parents=character.skeleton.parents))
        return mesh.positions, mesh.frames

    def frame(index: int) -> PosedMesh:
        pose = jax.tree.map(lambda values: values[index], motion.pose)
        positions, frames = posed(pose)
        return np.asarray(positions), np.asarray(frames)

    return frame


def sequence_frames(sequence: MeshSequence) -> Callable[[int], PosedMesh]:
    """The same for a mesh sequence; its arrays are checked first."""
    check_finite("mesh sequence", "vertices", np.asarray(sequence.vertices))
    check_finite("mesh sequence", "frames", np.asarray(sequence.frames))
    check_finite("mesh sequence", "features", np.asarray(sequence.features))
    return lambda index: (np.asarray(sequence.vertices[index]), np.asarray(sequence.frames[index]))


class VisibilityStore:
    """Packed visibility of p points in f frames, on disk."""

    def __init__(
        self,
        path: Path,
        *,
        num_frames: int,
        num_points: int,
        bake: BakeSettings,
        source: str,
        run: Mapping[str, Any] | None = None,
    ):
        """Opens the store at `path`, or makes it.

        Args:
          source: hash of the character, its poses and points.
          run: character and settings, to say what differs where the hash does.
        Raises:
          InputError: if something else is there: a bake of another character or of other settings, or a damaged one.
        """
        self.path, self.num_frames = path, num_frames
        # What is in the store follows from these.
        contents: dict[str, Any] = {
            "format": "jaxrender-visibility",
            "version": STORE_VERSION,
            "source": source,
            "num_frames": num_frames,
            "num_points": num_points,
            "num_directions": bake.num_directions,
        }
        shape = (num_frames, num_points, -(-bake.num_directions // 8))
        if not path.exists():
            with only_writer(path.parent):
                _remove_unfinished(path)
                # Another run may have made it while this one waited.
                if not path.exists():
                    _create(path, shape, {**contents, "run": to_jsonable(run or {})})
        _refuse_another(path, contents, to_jsonable(run or {}))
        try:
            self._visibility = zarr.open_array(path / "visibility", mode="r+")
            self._checksum = zarr.open_array(path / "checksum", mode="r+")
        except (OSError, ValueError, KeyError) as error:
            bad_input(path, "store", expected="whole descriptions of its arrays", got=f"{error}; {_WAY_OUT}")
        if self._visibility.shape != shape or self._checksum.shape != shape[:1]:
            bad_input(path, "store", expected=f"an array of shape {shape}", got=f"{self._visibility.shape}; {_WAY_OUT}")

    def remove_leftovers(self) -> None:
        """Removes what a killed process left half-written; only while nobody else writes."""
        for file in self.path.rglob("*.partial"):
            file.unlink(missing_ok=True)

    def missing(self) -> Int[np.ndarray, " n"]:
        """Frames not baked yet, and those that are not on disk as they were written."""
        return np.flatnonzero([self._frame(index) is None for index in range(self.num_frames)])

    def write(self, frame: int, bits: UInt8[np.ndarray, "p bytes"]) -> None:
        try:
            self._visibility[frame] = bits
            self._checksum[frame] = _checksum(bits)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def read(self) -> UInt8[np.ndarray, "f p bytes"]:
        """All frames; a bit per ray, so 10,000 points x 300 frames x 256 directions are 96 MB.

        Raises:
          InputError: if a frame is missing or damaged.
        """
        bits = np.empty(self._visibility.shape, np.uint8)
        for index in range(self.num_frames):
            frame = self._frame(index)
            if frame is None:
                bad_input(self.path, f"frame {index}", expected="visibility as it was baked", got="none, or damaged")
            bits[index] = frame
        return bits

    def _frame(self, index: int) -> UInt8[np.ndarray, "p bytes"] | None:
        try:
            expected = int(np.asarray(self._checksum[index]))
            bits = np.asarray(self._visibility[index]) if expected else None
        except (OSError, RuntimeError, ValueError):
            return None
        return bits if bits is not None and _checksum(bits) == expected else None


_WAY_OUT = "take another -o, or delete this folder, or add --restart to bake anew"


def _create(path: Path, shape: tuple[int, int, int], header: dict[str, Any]) -> None:
    """An empty store, made beside its place and renamed: a store that is there is whole."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        group = zarr.create_group(temporary, attributes=header)
        group.create_array("visibility", shape=shape, chunks=(1, *shape[1:]), dtype="uint8")
        group.create_array("checksum", shape=shape[:1], chunks=(1,), dtype="uint64", fill_value=0)
        for file in temporary.rglob("zarr.json"):
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
        temporary.rename(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_store(path: Path) -> None:
    """Removes a visibility store, whatever it is of.

    Raises:
      InputError: if something else is there.
    """
    if path.exists() and not (path / "zarr.json").is_file():
        bad_input(path, "store", expected="nothing or a visibility store", got="something else")
    shutil.rmtree(path, ignore_errors=True)


def _remove_unfinished(path: Path) -> None:
    """Removes what a process left that was killed while it made a store."""
    for left in path.parent.glob(f".{path.name}.*"):
        shutil.rmtree(left, ignore_errors=True)


def _refuse_another(path: Path, contents: dict[str, Any], run: dict[str, Any]) -> None:
    """Raises InputError unless the store holds these contents; names the setting that differs, if one is to blame."""
    if not (path / "zarr.json").is_file():
        bad_input(path, "store", expected="nothing or a visibility store", got="something else")
    header = _read_header(path)
    if header is None or header.get("format") != contents["format"]:
        bad_input(path, "header", expected="that of a visibility store", got=f"damage; {_WAY_OUT}")
    difference = first_difference({name: header.get(name) for name in contents}, contents)
    if difference is not None:
        field, there, here = first_difference(header.get("run", {}), run) or difference
        bad_input(path, field, expected=f"{there}, as it was baked", got=f"{here}; {_WAY_OUT}")


def _checksum(bits: UInt8[np.ndarray, "p bytes"]) -> int:
    """Never 0, which stands for a frame that is not there."""
    return 1 << 32 | zlib.crc32(np.ascontiguousarray(bits).data)


def _read_header(path: Path) -> dict | None:
    try:
        return dict(zarr.open_group(path, mode="r").attrs)
    except (OSError, ValueError, KeyError, json.JSONDecodeError):
        return None


@dataclass(frozen=True)
class BakeStatistics:
    """Rays of the whole bake; those of the last run, which may have continued another, and how long they took."""

    num_rays: int
    num_traced: int
    seconds: float
    frames_done_before: int

    @property
    def rays_per_second(self) -> float:
        return self.num_traced / max(self.seconds, 1e-9)


def bake(
    store: VisibilityStore,
    frame: Callable[[int], PosedMesh],
    faces: Int[np.ndarray, "t 3"],
    points: Int[np.ndarray, " p"],
    settings: BakeSettings,
    *,
    track: Track = no_tracking,
) -> BakeStatistics:
    """Traces every missing frame into the store.

    Args:
      frame: frame number -> posed mesh.
      track: wraps the iteration over frames, for progress display.
    Raises:
      InputError: if frames are missing and another run writes to the folder of the store.
      OSError: if the disk is full; the frames before stay.
    """
    directions = hemisphere_directions(settings.num_directions)
    caster = VisibilityCaster(np.asarray(faces), directions, points=points, rays=settings.rays)
    missing = store.missing()
    started, total, rays_per_frame = time.perf_counter(), store.num_frames, len(points) * settings.num_directions
    # A whole store is only read, also while another run holds the folder.
    with only_writer(store.path.parent) if len(missing) else contextlib.nullcontext():
        if len(missing):
            store.remove_leftovers()
        for index in track(iter(missing), total, "bake", total - len(missing)):
            positions, frames = frame(int(index))
            if not (np.isfinite(positions).all() and np.isfinite(frames).all()):
                bad_input(f"frame {index}", "vertices", expected="finite numbers", got="NaN or Inf after skinning")
            store.write(int(index), caster.cast(positions, frames))
    seconds = time.perf_counter() - started
    return BakeStatistics(
        total * rays_per_frame, len(missing) * rays_per_frame, seconds, frames_done_before=total - len(missing)
    )


def mean_visibility(bits: UInt8[np.ndarray, "f p bytes"], num_directions: int) -> Float[np.ndarray, "f p"]:
    """Share of free directions per frame and point."""
    return np.bitwise_count(bits).sum(axis=-1, dtype=np.float32) / num_directions
