"""Mesa's software rasteriser as peer and judge: the same clip-space triangles through OpenGL, off screen.

Our clip space has z in [0, w] and rows count from the top; OpenGL's has z in [-w, w] and rows from the bottom. Here y
is negated before and nothing is flipped after, so that both walk the same memory: their fill rules, quads and sample
positions are the same, and dFdy is per row downwards.
"""

import ctypes
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

VERTEX = """
#version 450
in vec4 position;
in vec4 value;
%(place)s out vec4 smooth_value;
noperspective %(place)s out vec4 linear_value;
flat out vec4 flat_value;
void main() {
    gl_Position = vec4(position.x, -position.y, 2.0 * position.z - position.w, position.w);
    smooth_value = linear_value = flat_value = value;
}
"""
FRAGMENT = """
#version 450
%(uniforms)s
%(place)s in vec4 smooth_value;
noperspective %(place)s in vec4 linear_value;
flat in vec4 flat_value;
layout(location = 0) out int id;
layout(location = 1) out vec4 first;
layout(location = 2) out vec4 second;
layout(location = 3) out vec4 third;
layout(location = 4) out vec4 fourth;
layout(location = 5) out vec4 fifth;
void main() {
    id = gl_PrimitiveID;
    %(body)s
}
"""
#: What the three float targets receive: the value in each interpolation mode, or the value and its derivatives.
MODES = "first = smooth_value; second = linear_value; third = flat_value;"
DERIVATIVES = "first = smooth_value; second = dFdxFine(smooth_value); third = dFdyFine(smooth_value);"

# A triangle that fills the screen and lays the samples of each pixel side by side.
SCREEN = """
#version 450
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }
"""
SPREAD = """
#version 450
uniform %(kind)ssampler2DMS image;
uniform int samples;
out %(kind)svec4 value;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    value = texelFetch(image, ivec2(at.x / samples, at.y), at.x %% samples);
}
"""

_TEXTURE_2D, _WRAP_S, _WRAP_T = 0x0DE1, 0x2802, 0x2803
_WRAPS = {"repeat": 0x2901, "clamp": 0x812F, "mirror": 0x8370}


class NoOpenGL(Exception):
    """There is no llvmpipe here; the message says why."""


@functools.lru_cache
def context() -> Any:
    """An OpenGL context on llvmpipe.

    Raises:
      NoOpenGL: if there is none.
    """
    try:
        import moderngl

        made = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]
    except Exception as error:
        raise NoOpenGL(f"no OpenGL here (extra `peers`, apt packages libegl1, libgl1-mesa-dri): {error}") from error
    if "llvmpipe" not in made.info["GL_RENDERER"]:
        raise NoOpenGL(f"llvmpipe is asked for, and this is {made.info['GL_RENDERER']}")
    return made


def mip_texture(
    levels: Sequence[Float[np.ndarray, "_ _ 4"]],
    *,
    wrap: tuple[str, str] = ("repeat", "repeat"),
    max_anisotropy: int = 1,
) -> Any:
    """A float texture of just these levels, the finest first, filtered trilinearly.

    Args:
      wrap: "repeat", "clamp" or "mirror", for u and v.
      max_anisotropy: above 1, llvmpipe filters by EWA, and by derivatives of its own even in `textureGrad`.
    """
    import moderngl

    height, width, _ = levels[0].shape
    texture = context().texture((width, height), 4, dtype="f4")
    texture.build_mipmaps(0, len(levels) - 1)
    for level, texels in enumerate(levels):
        texture.write(np.ascontiguousarray(texels, np.float32).tobytes(), level=level)
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    texture.anisotropy = float(max_anisotropy)
    texture.use(0)
    for axis, mode in zip((_WRAP_S, _WRAP_T), wrap, strict=True):
        # The wrapper has no mirrored repeat.
        _texture_parameter()(_TEXTURE_2D, axis, _WRAPS[mode])
    return texture


@functools.lru_cache
def _texture_parameter() -> Any:
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    return ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_uint, ctypes.c_int)(egl.eglGetProcAddress(b"glTexParameteri"))


class Drawing:
    """Triangles and render targets that are ready to draw; release it when done."""

    def __init__(
        self,
        clip: Float[np.ndarray, "v 4"],
        faces: Int[np.ndarray, "t 3"],
        *,
        height: int,
        width: int,
        values: Float[np.ndarray, "v 4"] | None = None,
        body: str = MODES,
        num_targets: int = 3,
        samples: int = 1,
        place: str = "",
        textures: Mapping[str, Any] | None = None,
    ):
        """A drawing of `faces`.

        Args:
          values: of the vertices, which the fragments get interpolated.
          body: of the fragment shader; see `MODES`.
          num_targets: counts the vec4 targets beside that of the ids.
          samples: of a pixel, 1 or 4.
          place: where in the pixel values are interpolated: "" (its centre), "centroid" or "sample".
          textures: what `body` may sample, by name; released with the drawing.
        """
        self.gl, self.height, self.width, self.samples = context(), height, width, samples
        self.textures = dict(textures or {})
        corners = np.asarray(faces).reshape(-1)
        values = np.zeros((len(clip), 4), np.float32) if values is None else np.asarray(values, np.float32)
        packed = np.concatenate([np.asarray(clip, np.float32)[corners], values[corners]], axis=1).astype("f4")
        uniforms = "".join(f"uniform sampler2D {name};" for name in self.textures)
        fragment = FRAGMENT % {"place": place, "body": body, "uniforms": uniforms}
        self.program = self.gl.program(vertex_shader=VERTEX % {"place": place}, fragment_shader=fragment)
        for unit, name in enumerate(self.textures):
            # Those that `body` does not use are optimised away.
            if name in self.program:
                self.program[name] = unit
        used = [name for name in ("position", "value") if name in self.program]
        layout = "4f 4f" if "value" in used else "4f 16x"
        buffer = self.gl.buffer(packed.tobytes())
        self.array = self.gl.vertex_array(self.program, [(buffer, layout, *used)])
        size, several = (width, height), 0 if samples == 1 else samples
        self.ids = self.gl.texture(size, 1, samples=several, dtype="i4")
        self.images = [self.gl.texture(size, 4, samples=several, dtype="f4") for _ in range(num_targets)]
        self.depth = self.gl.depth_texture(size, samples=several)
        self.target = self.gl.framebuffer([self.ids, *self.images], self.depth)
        self._resources = [self.array, buffer, self.ids, *self.images, self.depth, self.target, self.program]
        self._resources += self.textures.values()

    def draw(self, *, cull: str = "none") -> None:
        """Clears and draws, and waits until it is done. Ids of empty samples are left as they were."""
        import moderngl

        self.target.use()
        self.gl.enable(moderngl.DEPTH_TEST)
        self.gl.depth_func = "<"
        # Negating y turns triangles around.
        self.gl.front_face = "cw"
        if cull == "none":
            self.gl.disable(moderngl.CULL_FACE)
        else:
            self.gl.enable(moderngl.CULL_FACE)
            self.gl.cull_face = cull
        self.target.clear(depth=1.0)
        for unit, texture in enumerate(self.textures.values()):
            texture.use(unit)
        self.array.render(moderngl.TRIANGLES)
        self.gl.finish()

    def read(
        self,
    ) -> tuple[Int[np.ndarray, "h w *s"], Float[np.ndarray, "h w *s"], list[Float[np.ndarray, "h w *s 4"]]]:
        """Ids (-1 where nothing was drawn), window depth, and the float targets; by sample where there are several."""
        depth = self._pixels(self.depth, np.float32, 1)[..., 0]
        ids = np.where(depth < 1.0, self._pixels(self.ids, np.int32, 1)[..., 0], -1)
        return ids, depth, [self._pixels(image, np.float32, 4) for image in self.images]

    def _pixels(self, texture: Any, kind: type, count: int) -> np.ndarray:
        if self.samples == 1:
            return np.frombuffer(texture.read(alignment=1), kind).reshape(self.height, self.width, count).copy()
        import moderngl

        spread = SPREAD % {"kind": "i" if kind is np.int32 else ""}
        program = self.gl.program(vertex_shader=SCREEN, fragment_shader=spread)
        program["samples"] = self.samples
        image = self.gl.texture((self.width * self.samples, self.height), count, dtype=f"{np.dtype(kind).kind}4")
        target, array = self.gl.framebuffer([image]), self.gl.vertex_array(program, [])
        target.use()
        texture.use(0)
        self.gl.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        array.render(moderngl.TRIANGLES, vertices=3)
        found: np.ndarray = np.frombuffer(image.read(alignment=1), kind).copy()
        for resource in (array, target, image, program):
            resource.release()
        return found.reshape(self.height, self.width, self.samples, count)

    def release(self) -> None:
        for resource in self._resources:
            resource.release()
