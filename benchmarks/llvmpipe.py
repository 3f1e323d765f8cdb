"""Mesa's software rasteriser as peer and judge: the same clip-space triangles through OpenGL, off screen.

Our clip space has z in [0, w] and rows count from the top; OpenGL's has z in [-w, w] and rows from the bottom. Here y
is negated before and nothing is flipped after, so that both walk the same memory, and their fill rules are the same.
"""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float, Int

VERTEX = """
#version 450
in vec4 position;
in vec4 value;
out vec4 smooth_value;
noperspective out vec4 linear_value;
flat out vec4 flat_value;
void main() {
    gl_Position = vec4(position.x, -position.y, 2.0 * position.z - position.w, position.w);
    smooth_value = linear_value = flat_value = value;
}
"""
FRAGMENT = """
#version 450
in vec4 smooth_value;
noperspective in vec4 linear_value;
flat in vec4 flat_value;
layout(location = 0) out int id;
layout(location = 1) out vec4 first;
layout(location = 2) out vec4 second;
layout(location = 3) out vec4 third;
void main() {
    id = gl_PrimitiveID;
    %s
}
"""
#: What the three float targets receive: the value in each interpolation mode, or the value and its derivatives.
MODES = "first = smooth_value; second = linear_value; third = flat_value;"
DERIVATIVES = "first = smooth_value; second = dFdxFine(smooth_value); third = dFdyFine(smooth_value);"


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
    ):
        """`num_targets` counts the vec4 targets beside that of the ids."""
        self.gl, self.height, self.width = context(), height, width
        corners = np.asarray(faces).reshape(-1)
        values = np.zeros((len(clip), 4), np.float32) if values is None else np.asarray(values, np.float32)
        packed = np.concatenate([np.asarray(clip, np.float32)[corners], values[corners]], axis=1).astype("f4")
        self.program = self.gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT % body)
        used = [name for name in ("position", "value") if name in self.program]
        layout = "4f 4f" if "value" in used else "4f 16x"
        buffer = self.gl.buffer(packed.tobytes())
        self.array = self.gl.vertex_array(self.program, [(buffer, layout, *used)])
        size = (width, height)
        self.ids = self.gl.texture(size, 1, dtype="i4")
        self.images = [self.gl.texture(size, 4, dtype="f4") for _ in range(num_targets)]
        self.depth = self.gl.depth_texture(size)
        self.target = self.gl.framebuffer([self.ids, *self.images], self.depth)
        self._resources = [self.array, buffer, self.ids, *self.images, self.depth, self.target, self.program]

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
        self.array.render(moderngl.TRIANGLES)
        self.gl.finish()

    def read(self) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w"], list[Float[np.ndarray, "h w 4"]]]:
        """Ids (-1 where nothing was drawn), window depth, and the float targets."""

        def pixels(texture: Any, kind: type, count: int) -> np.ndarray:
            return np.frombuffer(texture.read(alignment=1), kind).reshape(self.height, self.width, count).copy()

        depth = pixels(self.depth, np.float32, 1)[..., 0]
        ids = np.where(depth < 1.0, pixels(self.ids, np.int32, 1)[..., 0], -1)
        return ids, depth, [pixels(image, np.float32, 4) for image in self.images]

    def release(self) -> None:
        for resource in self._resources:
            resource.release()
