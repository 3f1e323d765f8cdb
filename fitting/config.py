"""Settings of a training run: frozen, validated, saved with the result."""

from dataclasses import asdict, dataclass, field
from typing import Literal

from jaxrender.checks import check_at_least, check_one_of

Features = Literal["surroundings", "exponential_map", "euler"]


@dataclass(frozen=True)
class BakeSettings:
    """What is traced."""

    frames_per_second: float = 30.0
    """Clips are resampled to this rate."""
    max_frames: int = 400
    """At most this many frames in all; longer motion is sampled more thinly, evenly over the clips."""
    num_directions: int = 256
    """Rays per point and frame, over the hemisphere of the normal; a multiple of 8."""
    num_mixed: int = 300
    """Further poses whose limbs come from different training frames; they teach poses no clip shows. 0: none."""
    max_points: int = 0
    """At most this many shading points, spread evenly over the mesh (0: all). The rest take their nearest one's."""
    seed: int = 0
    rays: Literal["auto", "embree", "jax"] = "auto"
    """Who casts them: Embree on the CPU, or the tree in JAX on its device. `auto`: Embree unless JAX has a GPU."""

    def __post_init__(self) -> None:
        check_one_of("rays", self.rays, ("auto", "embree", "jax"))
        check_at_least("frames_per_second", self.frames_per_second, 0.1)
        check_at_least("max_frames", self.max_frames, 2)
        check_at_least("num_directions", self.num_directions, 16)
        if self.num_directions % 8:
            raise ValueError(f"num_directions: expected a multiple of 8, got {self.num_directions}")
        check_at_least("num_mixed", self.num_mixed, 0)
        check_at_least("max_points", self.max_points, 0)


@dataclass(frozen=True)
class SplitSettings:
    """What is kept from training, to measure on."""

    segment_share: float = 0.2
    """The last part of every clip that is held out."""
    clips: tuple[str, ...] = ("auto",)
    """Names of clips held out whole. `auto`: every fourth clip of four or more. `none`: no clip."""

    def __post_init__(self) -> None:
        check_at_least("segment_share", self.segment_share, 0.0)
        if self.segment_share > 0.9:
            raise ValueError(f"segment_share: expected at most 0.9, got {self.segment_share}")


@dataclass(frozen=True)
class FitSettings:
    """The model and how it is fitted."""

    num_lobes: int = 2
    features: Features = "surroundings"
    """What of the pose the model sees: the body from each bone, or joint angles (for a mesh sequence: its matrix)."""
    num_components: int = 48
    """Principal components of the features that are kept per bone."""
    ridge: float | None = None
    """Penalty relative to the features' mean eigenvalue; None: chosen on motion held out of the training part."""
    mixed_weight: float = 0.2
    """Weight of a mixed pose relative to a real frame."""
    refine_steps: int = 30
    """Gauss-Newton steps on the whole map pose -> lobes -> SH. 0: stop at the linear solve."""
    offset: bool = True
    """Add a constant SH vector per point for what the lobes leave on average."""
    half_precision: bool = False
    """Store the pose matrices in float16."""

    def __post_init__(self) -> None:
        check_one_of("num_lobes", self.num_lobes, (1, 2, 3))
        check_at_least("num_components", self.num_components, 1)
        check_at_least("refine_steps", self.refine_steps, 0)
        check_at_least("mixed_weight", self.mixed_weight, 0.0)
        check_one_of("features", self.features, ("surroundings", "exponential_map", "euler"))
        if self.ridge is not None:
            check_at_least("ridge", self.ridge, 0.0)


@dataclass(frozen=True)
class TrainSettings:
    bake: BakeSettings = field(default_factory=BakeSettings)
    split: SplitSettings = field(default_factory=SplitSettings)
    fit: FitSettings = field(default_factory=FitSettings)

    def as_dict(self) -> dict:
        return asdict(self)
