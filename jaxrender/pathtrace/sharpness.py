"""How far the light that a glossy surface reflects may be blurred: windows as narrow as its lobe.

Guides tell surfaces apart, and nothing of what they mirror, so a filter that suits matt surfaces wipes reflections
away. The share of a mirrored image that a pixel sees grows with the lobe; so should the window. Filters run with a few
radii, and each pixel takes what lies between them at its own.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender import vec3
from jaxrender.pathtrace.scatter import Reflector
from jaxrender.vec3 import Scalar, dot

#: From one radius to the next.
_STEP = 4


def sharpness(at: Reflector) -> Scalar:
    """By which share the radius of a filter should be less than for a matt surface: 0 for that, 1 for a mirror.

    s (1 - α), with s the mirrored share of what is reflected towards wo (Schlick), α the square of the roughness. On a
    metal dragon, radii of α times that of the rule were best or next to best from a roughness of 0.1 to 0.6.
    """
    grazing = jnp.clip(1.0 - dot(at.normal, at.wo), 0.0, 1.0) ** 5
    mirror = vec3.mean(at.mirror)
    fresnel = jnp.where(mirror > 0.0, mirror + (1.0 - mirror) * grazing, 0.0)
    total = fresnel + vec3.mean(at.diffuse)
    return fresnel / jnp.where(total > 0.0, total, 1.0) * (1.0 - at.roughness**2)


def window_radii(largest: int, least: float) -> tuple[int, ...]:
    """Radii from `largest` down by quarters, 1 and 0, until one is no larger than `least`."""
    radii = [largest]
    while radii[-1] > least:
        radii.append(max(radii[-1] // _STEP, 1) if radii[-1] > 1 else 0)
    return tuple(radii)


def blend_windows(
    levels: Float[Array, "k h w c"], radii: Float[Array, " k"], wanted: Float[Array, "h w 1"]
) -> Float[Array, "h w c"]:
    """Images filtered with falling radii -> each pixel at the radius it wants, linearly in log(1 + r) between two.

    What is wanted beyond the largest or the smallest radius takes that. Differentiable in `levels`.
    """
    places, place = jnp.log1p(radii), jnp.log1p(wanted)

    def narrow(image: Array, step: tuple[Array, Array, Array]) -> tuple[Array, None]:
        level, before, here = step
        share = jnp.clip((before - place) / (before - here), 0.0, 1.0)
        return image + share * (level - image), None

    return jax.lax.scan(narrow, levels[0], (levels[1:], places[:-1], places[1:]))[0]
