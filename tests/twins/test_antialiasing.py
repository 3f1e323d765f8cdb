"""jaxrender.deferred.fxaa, sraa and mlaa against the twins: values and derivatives."""

import math

import numpy as np
import pytest

from tests.support.cases import Case
from tests.support.tolerances import LONG_SUM
from tests.twins.agreement import DTYPES, check

_rng = np.random.default_rng(2011)


def _noise(height: int, width: int, *, contrast: float = 1.0) -> np.ndarray:
    return 0.5 + contrast * (_rng.uniform(size=(height, width, 3)) - 0.5)


def _two_colours(height: int, width: int, slope: float) -> np.ndarray:
    """A slanted edge, and a thin line across it. Nearly all decisions are ties here."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    light = (y > 2.2 + slope * x) ^ (abs(y - height + 0.7 * x - 1.3) < 0.5)
    return np.where(light[..., None], [0.9, 0.7, 0.8], [0.15, 0.3, 0.2])


def _fxaa() -> list[Case]:
    # The result is image + s · (neighbour - image); s holds the fourth power of a quotient of lumas, each of which
    # carries some four roundings: tens of them in s. Decisions at ties are made the same way in both precisions.
    images = {
        "noise": (_noise(12, 13), {}),
        "low contrast": (_noise(9, 14, contrast=0.5), {"preset": 39, "edge_threshold": 0.063, "subpix": 1.0}),
        "two colours": (_two_colours(12, 26, 0.19), {"preset": 29}),
        "two colours, only edges": (_two_colours(26, 12, 2.6), {"preset": 10, "subpix": 0.0}),
        "one row": (_noise(1, 7), {"edge_threshold_min": 0.0312}),
        "one pixel": (_noise(1, 1), {"edge_threshold": 0.0, "edge_threshold_min": 0.0}),
    }
    return [
        Case("deferred.fxaa.luma", {"image": _noise(3, 4)}, gradients=("image",)),
        Case("deferred.fxaa.luma_range", {"luma": _noise(5, 6)[..., 0]}, gradients=("luma",)),
        *(
            Case("deferred.fxaa.fxaa", {"image": image, **options}, label, gradients=("image",))
            for label, (image, options) in images.items()
        ),
    ]


def _sraa() -> list[Case]:
    def scene(height: int, width: int, size: int) -> dict[str, np.ndarray]:
        samples = (height, width, size**2)
        normal = _rng.normal(size=(*samples, 3)) + [0.0, 0.0, 1.5]
        return {
            "shading": _rng.uniform(0, 4, (height, width, 3)),
            "depth": _rng.uniform(5, 6, samples),
            "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
            "covered": (_rng.uniform(size=samples) < 0.8) & (_rng.uniform(size=(height, width, 1)) < 0.8),
            "first": _rng.integers(0, size**2, (height, width)).astype(np.int32),
        }

    # -log weights are rounded in units of their terms, cosines and depths of 1 over sigma: 10 to 20 eps, and so are
    # the weights, relatively. Hence the long sum.
    options = {"sigma_depth": 0.1, "sigma_normal": 0.2}
    return [
        Case(
            "deferred.sraa.sraa",
            {**scene(height, width, size), "size": size, "sigma_space": space, **options},
            f"{height} x {width} x {size}², space {space}",
            gradients=("shading", "depth", "normal"),
            on={"normal": "sphere"},
            ulps32=LONG_SUM,
        )
        for height, width, size, space in ((5, 6, 2, math.inf), (4, 4, 3, 0.6), (1, 3, 1, 1.0))
    ]


def _mlaa() -> list[Case]:
    images = {
        "noise": (_noise(12, 13), {}),
        "two colours": (_two_colours(12, 26, 0.19), {"max_search_steps": 2}),
        "steep": (_two_colours(26, 12, 2.6), {"threshold": 0.3}),
        "light": (_two_colours(12, 26, 0.19), {"linear_light": True}),
        "light of noise": (_noise(9, 10), {"linear_light": True, "threshold": 0.02}),
        "one column": (_noise(7, 1), {}),
    }
    return [
        Case("deferred.mlaa.mlaa", {"image": image, **options}, label, gradients=("image",))
        for label, (image, options) in images.items()
    ]


CASES = [*_fxaa(), *_sraa(), *_mlaa()]


@pytest.mark.parametrize("dtype", DTYPES, ids=lambda d: np.dtype(d).name)
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.id)
def test_twin(case, dtype):
    check(case, dtype)
