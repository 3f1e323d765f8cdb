"""Files to records and back. Every reader checks what it reads and raises InputError in one line."""

from jaxrender.io.bvh import read_bvh as load_bvh  # noqa: F401
from jaxrender.io.character import load_character as load_character
from jaxrender.io.exr import read_exr as read_exr
from jaxrender.io.exr import read_exr_layers as read_exr_layers
from jaxrender.io.exr import write_exr as write_exr
from jaxrender.io.hdr import read_environment as read_environment
from jaxrender.io.layer_names import known_layers as known_layers
from jaxrender.io.picture import write_png as write_png
from jaxrender.io.scene import load_animated_scene as load_animated_scene
from jaxrender.io.scene import load_scene as load_scene
