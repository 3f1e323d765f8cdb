"""The m x m sub-samples of every pixel, of a scene or of a G-buffer; the surface is looked up only where asked for."""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import bad_input, check_at_least
from jaxrender.deferred.gbuffer import AttributeTable, GBuffer, smooth_points
from jaxrender.deferred.raster import Fragments
from jaxrender.scene import Material


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SceneSamples:
    """What a scene's rasterisation left: points on triangles.

    Attributes:
      material: of the scene. table: of `attribute_table`.
      triangle_id, screen_id, barycentrics, w: as in `Fragments`.
    """

    material: Material
    table: AttributeTable
    triangle_id: Int[Array, "h w n"]
    screen_id: Int[Array, "h w n"]
    barycentrics: Float[Array, "h w n 2"]
    w: Float[Array, "h w n"]

    @property
    def covered(self) -> Bool[Array, "h w n"]:
        return self.triangle_id >= 0

    @property
    def depth(self) -> Float[Array, "h w n"]:
        return self.w

    @property
    def one_surface(self) -> Bool[Array, "h w"]:
        """Whether all covered sub-samples of a pixel lie on one triangle."""
        covered, most = self.covered, jnp.max(self.triangle_id, axis=-1, keepdims=True)
        return jnp.all(~covered | (self.triangle_id == most), axis=-1)

    def look(
        self, place: Int[Array, "*b"], shift: Float[Array, "*b 2"] | None = None
    ) -> tuple[GBuffer, Float[Array, "*b 4"] | None]:
        """The surface at places of the image, counted through, or some pixels beside them; and its tangent."""
        flat = lambda values: values.reshape(-1, *values.shape[3:])[place]  # noqa: E731
        gbuffer, tangent, _ = smooth_points(
            self.table, flat(self.triangle_id), flat(self.screen_id), flat(self.barycentrics), flat(self.w), shift=shift
        )
        return gbuffer, tangent


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GBufferSamples:
    """A G-buffer with axes (h, w, n), and the materials that its ids mean."""

    material: Material
    gbuffer: GBuffer

    @property
    def covered(self) -> Bool[Array, "h w n"]:
        return self.gbuffer.coverage

    @property
    def depth(self) -> Float[Array, "h w n"]:
        return self.gbuffer.depth

    @property
    def one_surface(self) -> Bool[Array, "h w"]:
        """Never: ids of files need not tell triangles apart."""
        return jnp.zeros(self.depth.shape[:2], bool)

    def look(
        self, place: Int[Array, "*b"], shift: Float[Array, "*b 2"] | None = None
    ) -> tuple[GBuffer, Float[Array, "*b 4"] | None]:
        """The surface at places of the image, counted through; only texture coordinates are moved by `shift`."""
        found = jax.tree.map(lambda values: values.reshape(-1, *values.shape[3:])[place], self.gbuffer)
        if shift is not None:
            uv = found.uv + shift[..., :1] * found.duv_dx + shift[..., 1:] * found.duv_dy
            found = dataclasses.replace(found, uv=uv)
        return found, None


SubSamples = SceneSamples | GBufferSamples


def group_samples(gbuffer: GBuffer, *, size: int) -> GBuffer:
    """A G-buffer of one sample a pixel, m times as wide and high -> one of m x m samples a pixel.

    Derivatives of uv become those per pixel of the smaller image. Motion is in its pixels too.

    Raises:
      InputError: if the G-buffer has several samples a pixel, or its sides are no multiples of m.
    """
    check_at_least("size", size, 1)
    height, width, n = gbuffer.depth.shape
    if n != 1 or height % size or width % size:
        bad_input(
            "gbuffer", "shape", expected=f"one sample a pixel, sides that are multiples of {size}",
            got=(height, width, n),
        )  # fmt: skip

    def grouped(values: Array) -> Array:
        cut = values.reshape(height // size, size, width // size, size, *values.shape[3:])
        return cut.swapaxes(1, 2).reshape(height // size, width // size, size * size, *values.shape[3:])

    found = jax.tree.map(grouped, gbuffer)
    return dataclasses.replace(
        found,
        duv_dx=found.duv_dx * size,
        duv_dy=found.duv_dy * size,
        motion=None if found.motion is None else found.motion / size,
    )


def scene_samples(material: Material, table: AttributeTable, fragments: Fragments) -> SceneSamples:
    """The sub-samples of fragments of an ordered grid."""
    return SceneSamples(
        material=material, table=table, triangle_id=fragments.triangle_id, screen_id=fragments.screen_id,
        barycentrics=fragments.barycentrics, w=fragments.w,
    )  # fmt: skip
