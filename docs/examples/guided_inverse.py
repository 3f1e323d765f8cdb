"""Learns how far a denoiser should trust each of its guides, by gradients through the guided filter.

    python docs/examples/guided_inverse.py [folder for the picture]

A noisy picture is filtered with three guides: which surface a pixel belongs to, its depth, and a pattern painted on the
surfaces, of which the light knows nothing. `eps` says for each what contrast counts as an edge. It is found from one
noisy picture and its clean partner, as log eps, by gradient descent, and judged on noise it has not seen.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxrender.filters import guided_filter
from jaxrender.io import write_png

HEIGHT, WIDTH, RADIUS = 72, 96, 8


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Guides (h, w, 3) in [0, 1], and light (h, w, 1): a disc in front of a wall, each with its own gradient."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / HEIGHT
    disc = (x - 0.7) ** 2 + (y - 0.5) ** 2 < 0.09
    depth = np.where(disc, 0.3 + 0.3 * y, 0.6 + 0.25 * x)
    pattern = (np.floor(12.0 * x) + np.floor(12.0 * y)) % 2.0
    light = np.where(disc, 0.9 - 0.8 * y, 0.15 + 0.2 * x + 0.1 * np.sin(5.0 * y))
    return np.stack([disc, depth, pattern], axis=-1).astype(np.float32), light[..., None].astype(np.float32)


def rendered(light: np.ndarray, seed: int) -> np.ndarray:
    """The light as a path tracer sees it with one sample a pixel: noise as large as what is measured."""
    return light * np.random.default_rng(seed).exponential(size=light.shape).astype(np.float32)


def denoise(log_eps: jax.Array, guide: jax.Array, noisy: jax.Array) -> jax.Array:
    return guided_filter(guide, noisy, radius=RADIUS, eps=jnp.exp(log_eps))


def error(log_eps: jax.Array, guide: jax.Array, noisy: jax.Array, light: jax.Array) -> jax.Array:
    """Mean squared."""
    return jnp.mean((denoise(log_eps, guide, noisy) - light) ** 2)


@jax.jit
def learn(log_eps: jax.Array, guide: jax.Array, noisy: jax.Array, light: jax.Array) -> jax.Array:
    """Steps along the slope, all of one length, which shrinks."""

    def step(k, log_eps):
        slope = jax.grad(error)(log_eps, guide, noisy, light)
        return log_eps - 0.5 * 0.97**k * slope / (jnp.linalg.norm(slope) + 1e-12)

    return jax.lax.fori_loop(0, 60, step, log_eps)


def main(folder: Path) -> dict[str, float]:
    guide, light = scene()
    start = jnp.full(3, jnp.log(0.01))
    found = learn(start, guide, rendered(light, seed=0), light)
    fresh = rendered(light, seed=1)
    before, after = (np.asarray(jax.jit(denoise)(log_eps, guide, fresh)) for log_eps in (start, found))
    row = np.clip(np.concatenate([fresh, before, after, light], axis=1), 0.0, 1.0)
    write_png(folder / "guided_inverse.png", np.repeat(row, 3, axis=2))
    result = {f"error {name}": float(np.mean((x - light) ** 2)) for name, x in (("before", before), ("after", after))}
    result |= zip(("eps of surface", "eps of depth", "eps of pattern"), jnp.exp(found).tolist(), strict=True)
    for name, value in result.items():
        print(f"{name:16s} {value:.2e}")
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
