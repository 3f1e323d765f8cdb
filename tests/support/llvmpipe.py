"""llvmpipe for tests: skips where it is missing, draws once and reads everything."""

import numpy as np
import pytest

from benchmarks import llvmpipe as peer
from benchmarks.llvmpipe import DERIVATIVES as DERIVATIVES
from benchmarks.llvmpipe import MODES as MODES


def context():
    """The OpenGL context; the calling test is skipped where there is none."""
    try:
        return peer.context()
    except peer.NoOpenGL as error:
        pytest.skip(str(error))


def draw(clip, faces, *, height, width, cull="none", **options):
    """Ids (h, w), window depth (h, w) and three vec4 images, by sample if there are several; `Drawing` has options."""
    drawing = peer.Drawing(clip, faces, height=height, width=width, **options)
    drawing.draw(cull=cull)
    found = drawing.read()
    drawing.release()
    return found


def look_up(levels, uv, call, *, wrap=("repeat", "repeat"), lod=0.0, duv_dx=0.0, duv_dy=0.0):
    """RGBA of a texture with just these levels, at every uv (h, w, 2).

    Args:
      call: in GLSL, of `image`, `uv`, `lod`, `dx` and `dy`: "textureGrad(image, uv, dx, dy)".
    """
    height, width, _ = uv.shape
    place, step = np.zeros((height, width, 4), np.float32), np.zeros((height, width, 4), np.float32)
    place[..., :2], place[..., 2], step[..., :2], step[..., 2:] = uv, lod, duv_dx, duv_dy
    textures = {"image": peer.mip_texture(levels, wrap=wrap)}
    textures |= {name: peer.mip_texture([image]) for name, image in (("places", place), ("steps", step))}
    body = """
        vec4 place = texelFetch(places, ivec2(gl_FragCoord.xy), 0), step = texelFetch(steps, ivec2(gl_FragCoord.xy), 0);
        vec2 uv = place.xy, dx = step.xy, dy = step.zw;
        float lod = place.z;
        first = %s;
    """
    screen = np.array([[-1, -1, 0.5, 1], [3, -1, 0.5, 1], [-1, 3, 0.5, 1]], np.float32)
    one = np.array([[0, 1, 2]])
    return draw(screen, one, height=height, width=width, body=body % call, num_targets=1, textures=textures)[2][0]
