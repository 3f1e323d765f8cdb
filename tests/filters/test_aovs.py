"""The record of a denoiser's images: what fits together, and what is said of what does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters.aovs import Aovs

COLOR = np.zeros((4, 5, 3), np.float32)


def test_images_of_numpy_and_jax_fit_and_are_a_tree():
    aovs = Aovs(COLOR, normal=jnp.ones((4, 5, 3)), depth=jnp.ones((4, 5, 1), jnp.bfloat16))
    aovs.check()
    assert list(aovs.given()) == ["color", "normal", "depth"]
    doubled = jax.tree.map(lambda image: 2 * image, aovs)
    assert doubled.albedo is None and float(doubled.depth.max()) == 2.0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"color": np.zeros((4, 5, 1), np.float32)}, r"color: expected shape \(4, 5, 3\).*got \(4, 5, 1\)"),
        ({"color": np.zeros((0, 5, 3), np.float32)}, "color: expected shape"),
        ({"normal": np.zeros((4, 6, 3), np.float32)}, r"normal: expected shape \(4, 5, 3\).*got \(4, 6, 3\)"),
        ({"depth": COLOR}, r"depth: expected shape \(4, 5, 1\), as color has it, got \(4, 5, 3\)"),
        ({"albedo": np.zeros((4, 5, 3), np.uint8)}, "albedo: expected floating point, got uint8"),
        ({"direct": COLOR}, "direct, indirect: expected both or none, got direct alone"),
        ({"indirect": COLOR}, "direct, indirect: expected both or none, got indirect alone"),
    ],
)
def test_what_does_not_fit_is_named(given, words):
    with pytest.raises(ValueError, match=words):
        Aovs(**{"color": COLOR, **given}).check()
