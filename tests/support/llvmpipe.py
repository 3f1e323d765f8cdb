"""Mesa's software rasteriser as a judge: the same clip-space triangles through OpenGL, off screen.

Our clip space has z in [0, w] and rows count from the top; OpenGL's has z in [-w, w] and rows from the bottom. Here y
is negated before and nothing is flipped after, so that both walk the same memory, and their fill rules are the same.
"""

import functools

import numpy as np
import pytest


@functools.lru_cache
def context():
    """An OpenGL context on llvmpipe; the calling test is skipped where there is none."""
    moderngl = pytest.importorskip("moderngl", reason="moderngl is not installed (extra: peers)")
    try:
        made = moderngl.create_standalone_context(backend="egl")
    except Exception as error:
        pytest.skip(f"no OpenGL here (apt packages libegl1, libgl1-mesa-dri): {error}")
    if "llvmpipe" not in made.info["GL_RENDERER"]:
        pytest.skip(f"the judge is llvmpipe, and this is {made.info['GL_RENDERER']}")
    return made


VERTEX = """
#version 450
in vec4 position;
in vec4 value;
out vec4 smooth_value;
noperspective out vec4 linear_value;
flat out vec4 flat_value;
centroid out vec4 centroid_value;
void main() {
    gl_Position = vec4(position.x, -position.y, 2.0 * position.z - position.w, position.w);
    smooth_value = linear_value = flat_value = centroid_value = value;
}
"""
FRAGMENT = """
#version 450
in vec4 smooth_value;
noperspective in vec4 linear_value;
flat in vec4 flat_value;
centroid in vec4 centroid_value;
layout(location = 0) out int id;
layout(location = 1) out vec4 first;
layout(location = 2) out vec4 second;
layout(location = 3) out vec4 third;
void main() {
    id = gl_PrimitiveID;
    %s
}
"""
MODES = "first = smooth_value; second = linear_value; third = flat_value;"
DERIVATIVES = "first = smooth_value; second = dFdxFine(smooth_value); third = dFdyFine(smooth_value);"


def draw(clip, faces, *, height, width, values=None, body=MODES, cull="none"):
    """Ids (h, w), window depth (h, w) and three vec4 images, as `FRAGMENT` writes them."""
    import moderngl

    gl = context()
    corners = np.asarray(faces).reshape(-1)
    values = np.zeros((len(clip), 4), np.float32) if values is None else np.asarray(values, np.float32)
    packed = np.concatenate([np.asarray(clip, np.float32)[corners], values[corners]], axis=1).astype("f4")
    program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT % body)
    used = [name for name in ("position", "value") if name in program]
    layout = "4f 4f" if "value" in used else "4f 16x"
    array = gl.vertex_array(program, [(gl.buffer(packed.tobytes()), layout, *used)])
    size = (width, height)
    ids = gl.texture(size, 1, dtype="i4")
    images = [gl.texture(size, 4, dtype="f4") for _ in range(3)]
    depth = gl.depth_texture(size)
    target = gl.framebuffer([ids, *images], depth)
    target.use()
    gl.enable(moderngl.DEPTH_TEST)
    gl.depth_func = "<"
    # Negating y turns triangles around.
    gl.front_face = "cw"
    if cull == "none":
        gl.disable(moderngl.CULL_FACE)
    else:
        gl.enable(moderngl.CULL_FACE)
        gl.cull_face = cull
    target.clear(depth=1.0)
    ids.write(np.full((height, width), -1, np.int32).tobytes())
    array.render(moderngl.TRIANGLES)
    gl.finish()
    read = lambda texture, kind, n: np.frombuffer(texture.read(alignment=1), kind).reshape(height, width, n)  # noqa: E731
    found = read(ids, np.int32, 1)[..., 0].copy(), read(depth, np.float32, 1)[..., 0].copy()
    pictures = [read(image, np.float32, 4).copy() for image in images]
    for resource in (array, ids, *images, depth, target, program):
        resource.release()
    return (*found, pictures)
