"""One door for animated characters: glTF, GLB or BVH, told apart by content."""

from pathlib import Path

from jaxrender.animation.skinning import Character
from jaxrender.io.bvh import read_bvh_character
from jaxrender.io.gltf import read_gltf


def load_character(path: str | Path, *, num_vertices: int = 5000) -> Character:
    """Reads a skinned, animated character.

    Args:
      path: glTF 2.0 (.gltf, .glb), or motion capture (.bvh), around which a mannequin is grown.
      num_vertices: of that mannequin.
    Raises:
      InputError: if the file is none of these, damaged, or uses something that is not supported.
      OSError: if it cannot be read.
    """
    with open(path, "rb") as file:
        start = file.read(512)
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").upper().startswith(b"HIERARCHY"):
        return read_bvh_character(path, num_vertices=num_vertices)
    return read_gltf(path)
