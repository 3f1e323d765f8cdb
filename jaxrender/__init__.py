"""Rendering research as pure tensor kernels.

Conventions, the same everywhere (docs/conventions.md has the reasons):

- Right-handed world, +Y up, metres. The camera looks down -Z of view space. Angles are in radians.
- Images are `(h, w, c)`, row 0 on top, pixel centres at +0.5, linear RGB float32. Triangle id -1 is empty.
- Directions are unit and leave the surface: `wo` to the eye, `wi` to the light.
- A vertex frame has the skinned normal as its z.
- Spherical harmonics are real, orthonormal, with the Condon-Shortley sign, index `l * (l + 1) + m`; `order` counts
  bands (order 4 has 16 coefficients). Converters to other layouts: `jaxrender.harmonics.sh_to_layout`.
- Arrays first, then `*`, then options. Pointwise kernels take any leading axes; `jit` and `vmap` are the caller's.

The rooms are subpackages: `jaxrender.io` (files), `jaxrender.animation` (skeletons, skinning, the built-in body),
`jaxrender.deferred` (rasteriser, quads, textures, G-buffer, shading), `jaxrender.harmonics` (visibility, lobes,
relighting), `jaxrender.pathtrace` (the CPU ray backend).
"""

from jaxrender.camera import Camera as Camera
from jaxrender.checks import InputError as InputError
from jaxrender.machine import avoid_wrong_sums as _avoid_wrong_sums
from jaxrender.scene import Lights as Lights
from jaxrender.scene import Material as Material
from jaxrender.scene import Mesh as Mesh
from jaxrender.scene import MeshSequence as MeshSequence
from jaxrender.scene import Scene as Scene
from jaxrender.scene import make_mesh_sequence as make_mesh_sequence
from jaxrender.scene import vertex_normals as vertex_normals

__version__ = "0.1.0"

_avoid_wrong_sums()  # before anybody makes an array
