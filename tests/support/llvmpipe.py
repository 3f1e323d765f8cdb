"""llvmpipe for tests: skips where it is missing, draws once and reads everything."""

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


def draw(clip, faces, *, height, width, values=None, body=MODES, cull="none"):
    """Ids (h, w), window depth (h, w) and three vec4 images."""
    drawing = peer.Drawing(clip, faces, height=height, width=width, values=values, body=body)
    drawing.draw(cull=cull)
    found = drawing.read()
    drawing.release()
    return found
