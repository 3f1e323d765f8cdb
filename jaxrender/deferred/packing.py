"""GBuffer <-> 8-bit channels, as a deferred renderer keeps it in video memory: 33 bytes a sample instead of 92.

Codes have no gradient.

References:
  Holländer, Boubekeur, Eisemann, "Adaptive Supersampling for Deferred Anti-Aliasing", 2013, section 4 (channels of 8
  bits); Cigolle et al., "A Survey of Efficient Representations for Independent Unit Vectors", JCGT 3(2), 2014.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxrender.camera import Camera, camera_rays
from jaxrender.checks import check_one_of
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.samples import CENTER, Samples
from jaxrender.vecmath import dot, normalize

NORMAL_BITS, DEPTH_BITS = (8, 16), (16, 24)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PackedGBuffer:
    """A G-buffer in bytes; the last axis but one, where there is one, counts components, the last one bytes.

    Attributes:
      normal, geometric_normal: octahedral, 8 or 16 bits a component.
      depth: linear, 16 or 24 bits of `far`.
      uv: 24 bits between the corners of `uv_box`, of the whole buffer.
      duv_dx, duv_dy: half floats.
      color: linear, 8 bits.
      material_id, triangle_id: as they were.
    """

    normal: UInt8[Array, "*b 2 n"]
    geometric_normal: UInt8[Array, "*b 2 n"]
    depth: UInt8[Array, "*b d"]
    uv: UInt8[Array, "*b 2 3"]
    duv_dx: Float[Array, "*b 2"]
    duv_dy: Float[Array, "*b 2"]
    color: UInt8[Array, "*b 4"]
    material_id: Int[Array, "*b"]
    triangle_id: Int[Array, "*b"]
    far: Float[Array, ""]
    uv_box: Float[Array, "2 2"]
    samples: Samples = field(metadata={"static": True})


def pack_gbuffer(
    gbuffer: GBuffer, *, samples: Samples = CENTER, normal_bits: int = 8, depth_bits: int = 24
) -> PackedGBuffer:
    """Rounds to the nearest codes. Positions are left out: depth and camera tell them. So is motion.

    Args:
      samples: of the fragments.
      normal_bits: of each of two components: 8 (0.34° off on average, 0.95° at most) or 16 (0.0013°, 0.0037°).
      depth_bits: 16 or 24, of the greatest depth in the buffer.
    """
    check_one_of("normal_bits", normal_bits, NORMAL_BITS)
    check_one_of("depth_bits", depth_bits, DEPTH_BITS)
    far = jnp.maximum(jnp.max(gbuffer.depth), 1e-30)
    some = gbuffer.coverage[..., None]
    low, high = (
        jnp.where(some, gbuffer.uv, bound).reshape(-1, 2) for bound in (jnp.float32(jnp.inf), -jnp.float32(jnp.inf))
    )
    box = jnp.stack([jnp.min(low, axis=0, initial=1e30), jnp.max(high, axis=0, initial=-1e30)])
    extent = jnp.maximum(box[1] - box[0], 1e-30).reshape(*(1,) * (gbuffer.uv.ndim - 1), 2)
    within = jnp.where(some, (gbuffer.uv - box[0].reshape(extent.shape)) / extent, 0.0)
    octahedral = lambda n: 0.5 + 0.5 * encode_octahedral(n)  # noqa: E731
    return PackedGBuffer(
        normal=_to_bytes(octahedral(gbuffer.normal), normal_bits),
        geometric_normal=_to_bytes(octahedral(gbuffer.geometric_normal), normal_bits),
        depth=_to_bytes(gbuffer.depth / far, depth_bits),
        uv=_to_bytes(within, 24),
        duv_dx=gbuffer.duv_dx.astype(jnp.float16),
        duv_dy=gbuffer.duv_dy.astype(jnp.float16),
        color=_to_bytes(gbuffer.color, 8)[..., 0],
        material_id=gbuffer.material_id,
        triangle_id=gbuffer.triangle_id,
        far=far,
        uv_box=box,
        samples=samples,
    )


def unpack_gbuffer(packed: PackedGBuffer, camera: Camera) -> GBuffer:
    """The values of the codes; positions on the camera's rays, where the depth says.

    Args:
      camera: the one of the picture; it has (h, w, s) samples.
    """
    some = packed.triangle_id >= 0
    value = lambda codes: jnp.where(some[..., None], _from_bytes(codes), 0.0)  # noqa: E731
    normal, geometric = (
        jnp.where(some[..., None], decode_octahedral(2.0 * _from_bytes(codes) - 1.0), 0.0)
        for codes in (packed.normal, packed.geometric_normal)
    )
    depth = jnp.where(some, _from_bytes(packed.depth) * packed.far, 0.0)
    box = packed.uv_box.reshape(2, *(1,) * some.ndim, 2)
    return GBuffer(
        position=jnp.where(some[..., None], positions_from_depth(depth, camera, samples=packed.samples), 0.0),
        normal=normal,
        geometric_normal=geometric,
        uv=jnp.where(some[..., None], box[0] + value(packed.uv) * (box[1] - box[0]), 0.0),
        duv_dx=packed.duv_dx.astype(depth.dtype),
        duv_dy=packed.duv_dy.astype(depth.dtype),
        color=value(packed.color[..., None]),
        depth=depth,
        material_id=packed.material_id,
        triangle_id=packed.triangle_id,
    )


def positions_from_depth(
    depth: Float[Array, "h w s"], camera: Camera, *, samples: Samples = CENTER
) -> Float[Array, "h w s 3"]:
    """World positions of samples at linear view depths."""
    height, width, _ = depth.shape
    ahead = normalize(camera.target - camera.eye).reshape(1, 1, 3)
    places = []
    for k, offset in enumerate(samples.positions_px):
        origins, directions = camera_rays(camera, height=height, width=width, offsets=jnp.asarray(offset, depth.dtype))
        places.append(origins + directions * depth[:, :, k, None] / dot(directions, ahead))
    return jnp.stack(places, axis=2)


def encode_octahedral(n: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
    """Unit vectors on the square [-1, 1]²: the octahedron |x| + |y| + |z| = 1, its lower half folded outwards.

    The zero vector goes to the middle.

    References:
      Cigolle et al. 2014, listing 1.
    """
    size = jnp.sum(jnp.abs(n), axis=-1, keepdims=True)
    p = n[..., :2] / jnp.where(size > 0.0, size, 1.0)
    return jnp.where(n[..., 2:] < 0.0, _folded(p), p)


def decode_octahedral(p: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """The inverse of `encode_octahedral`, for any point of the square."""
    z = 1.0 - jnp.sum(jnp.abs(p), axis=-1, keepdims=True)
    return normalize(jnp.concatenate([jnp.where(z < 0.0, _folded(p), p), z], axis=-1))


def _folded(p: Float[Array, "*b 2"]) -> Float[Array, "*b 2"]:
    return (1.0 - jnp.abs(p[..., ::-1])) * jnp.where(p >= 0.0, 1.0, -1.0)


def _to_bytes(value: Float[Array, "*b"], bits: int) -> UInt8[Array, "*b n"]:
    """Nearest code of [0, 1], its lowest byte first."""
    code = jnp.round(jnp.clip(value, 0.0, 1.0) * float(2**bits - 1)).astype(jnp.uint32)
    shifts = jnp.asarray(np.arange(0, bits, 8), jnp.uint32).reshape(*(1,) * value.ndim, -1)
    return (code[..., None] >> shifts & jnp.uint32(255)).astype(jnp.uint8)


def _from_bytes(codes: UInt8[Array, "*b n"]) -> Float[Array, "*b"]:
    n = codes.shape[-1]
    weights = jnp.asarray(256.0 ** np.arange(n), jnp.float32).reshape(*(1,) * (codes.ndim - 1), n)
    return jnp.sum(codes.astype(jnp.float32) * weights, axis=-1) / float(2 ** (8 * n) - 1)
