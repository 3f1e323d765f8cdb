"""Methods with lobes, from fits of every frame on its own to the joint refinement."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.checkpoint import Arrays, Checkpoint, as_arrays, from_arrays
from fitting.errors import SH
from fitting.fit import Block, block_arrays, blocks, fit_block, predict_block, start_axes
from fitting.solve import ORDER, lobe_targets, padded, synthesize
from fitting.stages import Track
from fitting.study.ground import Ground, LinearPose, MethodRow, method_row
from jaxrender.harmonics.pose_model import lobes_from_numbers
from jaxrender.harmonics.zh import lobes_to_sh
from jaxrender.machine import on_all_cores

LOBE_COUNTS = (1, 2, 3)
# Points of a block in the study, whose points are few per group.
STUDY_BLOCK = 16


def in_blocks(function: Callable, *arrays: np.ndarray, size: int = 1024):
    """function(*rows) of a compiled function, a fixed number of rows at a time, on all cores."""

    def one(start: int):
        rows = [array[start : start + size] for array in arrays]
        return np.asarray(function(*(padded(r, size) for r in rows)))[: len(rows[0])]

    return np.concatenate(list(on_all_cores(one, range(0, len(arrays[0]), size))))


_from_charts = jax.jit(synthesize)
_fixed_axis_numbers = jax.jit(lobe_targets)


@jax.jit
def _linearize(numbers, axes):
    """SH of each row's 6c numbers (n, 16) and its derivative (n, d, 16)."""

    def along(tangent):
        return jax.jvp(lambda x: synthesize(x[None], axes)[0], (numbers,), (jnp.broadcast_to(tangent, numbers.shape),))[
            1
        ]

    jacobian = jax.vmap(along)(jnp.eye(numbers.shape[-1], dtype=numbers.dtype))
    return synthesize(numbers[None], axes)[0], jnp.swapaxes(jacobian, 0, 1)


def fit_rows(sh, axes, *, penalty: Float[np.ndarray, " d"], num_steps: int = 12) -> Float[np.ndarray, "n d"]:
    """Levenberg-Marquardt over the 6c numbers of each row: |SH - sh|² + Σ penalty x², charts around `axes`.

    `jaxrender.harmonics.fit_zh_lobes` minimises the same with the coefficients eliminated; here the small systems are
    solved outside XLA, because its program takes longer to compile than the study to run.
    """
    numbers = np.asarray(_fixed_axis_numbers(sh[None], axes))[0]

    def normal_equations(x):
        predicted, jacobian = (np.asarray(a) for a in _linearize(x, axes))
        rest = predicted - sh
        value = np.sum(rest * rest, axis=-1) + (x * x) @ penalty
        return value, np.einsum("ndk,nk->nd", jacobian, rest) + penalty * x, jacobian @ jacobian.swapaxes(1, 2)

    value, gradient, matrix = normal_equations(numbers)
    damping, unit = np.full(len(sh), 1e-2, np.float32), np.eye(numbers.shape[1], dtype=np.float32)
    for _ in range(num_steps):
        damped = matrix + (damping[:, None, None] + penalty) * unit
        trial = numbers - np.linalg.solve(damped, gradient[..., None])[..., 0]
        new = normal_equations(trial)
        better = new[0] < value
        numbers = np.where(better[:, None], trial, numbers)
        value, gradient = np.where(better, new[0], value), np.where(better[:, None], new[1], gradient)
        matrix = np.where(better[:, None, None], new[2], matrix)
        damping = np.clip(np.where(better, 0.2 * damping, 8.0 * damping), 1e-5, 1e3)
    return numbers


@jax.jit
def _angles_from_charts(numbers, axes):
    turned, coefficients = lobes_from_numbers(numbers, axes)
    x, y, z = (turned[..., i] for i in range(3))
    angles = jnp.stack([jnp.arccos(jnp.clip(z, -1.0, 1.0)), jnp.arctan2(y, x)], axis=-1)
    lead = numbers.shape[:-1]
    return jnp.concatenate([angles.reshape(*lead, -1), coefficients.reshape(*lead, -1)], axis=-1)


@jax.jit
def _from_angles(numbers):
    c = numbers.shape[-1] // 6
    angles = numbers[..., : 2 * c].reshape(*numbers.shape[:-1], c, 2)
    theta, phi = angles[..., 0], angles[..., 1]
    axes = jnp.stack([jnp.sin(theta) * jnp.cos(phi), jnp.sin(theta) * jnp.sin(phi), jnp.cos(theta)], axis=-1)
    return lobes_to_sh(numbers[..., 2 * c :].reshape(*numbers.shape[:-1], c, ORDER), axes)


def point_axes(ground: Ground, num_lobes: int) -> Float[np.ndarray, "n c 3"]:
    """One set of axes per point for all its training frames: the best of several matching pursuits."""
    starts = np.asarray(start_axes(ground.sh[ground.train], num_lobes=num_lobes, count=6))
    errors = []
    for axes in starts:
        fitted = np.asarray(_from_charts(_fixed_axis_numbers(ground.sh, axes), axes))
        errors.append(np.sum((fitted - ground.sh)[ground.train] ** 2, axis=(0, 2)))
    return starts[np.argmin(errors, axis=0), ground.all_points]


def free_fits(sh: Float[np.ndarray, "n 16"], num_lobes: int) -> Float[np.ndarray, "n d"]:
    """θ, φ and coefficients of each row fitted on its own, the better of two starts."""
    penalty = np.full(6 * num_lobes, 1e-6, np.float32)

    def block(rows):
        found = []
        for start in np.asarray(start_axes(rows[None], num_lobes=num_lobes, count=2)):
            numbers = fit_rows(rows, start, penalty=penalty)
            error = np.sum((np.asarray(_linearize(numbers, start)[0]) - rows) ** 2, axis=-1)
            found.append((np.asarray(_angles_from_charts(numbers, start)), error))
        (a, error_a), (b, error_b) = found
        return np.where((error_a <= error_b)[:, None], a, b)

    return in_blocks(block, sh)


def raw_angle_lobes(ground: Ground, num_lobes: int, poses: Sequence[LinearPose]) -> tuple[SH, list[SH]]:
    """Each frame fitted on its own, and its θ, φ and coefficients made linear in each kind of pose features."""
    f, n, k = ground.sh.shape
    numbers = free_fits(ground.sh.reshape(f * n, k), num_lobes).reshape(f, n, -1)
    return np.asarray(_from_angles(numbers)), [np.asarray(_from_angles(pose.predict(numbers))) for pose in poses]


def anchored_lobes(ground: Ground, axes: Float[np.ndarray, "n c 3"]) -> SH:
    """Each frame fitted near the point's own axes; chart coordinates and coefficients linear in pose.

    The penalty is μ(|chart|² + 0.01 |z|²), μ = 0.01 for one lobe and 0.1 for more.
    """
    (f, n, k), c = ground.sh.shape, axes.shape[1]
    mu = 0.01 if c == 1 else 0.1
    penalty = np.concatenate([np.full(2 * c, mu), np.full(4 * c, 0.01 * mu)]).astype(np.float32)
    repeated = np.broadcast_to(axes, (f, *axes.shape)).reshape(f * n, c, 3)
    fit = functools.partial(fit_rows, penalty=penalty, num_steps=8)
    numbers = in_blocks(fit, ground.sh.reshape(f * n, k), repeated).reshape(f, n, -1)
    return np.asarray(_from_charts(ground.linear.predict(numbers), axes))


def fixed_axis_lobes(ground: Ground, axes: Float[np.ndarray, "n c 3"]) -> SH:
    """Axes fixed per point, coefficients linear in pose."""
    numbers = np.asarray(_fixed_axis_numbers(ground.sh, axes))
    return np.asarray(_from_charts(ground.linear.predict(numbers), axes))


def refined_lobes(ground: Ground, num_lobes: int, *, offset: bool, track: Track, checkpoint: Checkpoint) -> SH:
    """The training proper (fit_block) for another number of lobes, in blocks small enough for a few points a group."""
    fit = dataclasses.replace(ground.fit, num_lobes=num_lobes, offset=offset)
    linear, used, result = ground.linear, ground.linear.weights > 0, np.empty_like(ground.sh)
    todo = blocks(ground.data.groups, ground.all_points, size=STUDY_BLOCK)

    def solve(block: Block) -> Arrays:
        return block_arrays(fit_block(linear.rows(block.group), ground.sh[used][:, block.padded], fit))

    name = f"study_{num_lobes}_lobes_{'offset' if offset else 'plain'}"
    stage = checkpoint.stage(name, ground.data, linear, fit)
    for number, fitted in stage.parts(todo, solve, track=track, label=count_lobes(num_lobes)):
        block = todo[number]
        components = linear.components[:, block.group].astype(np.float32)
        predicted = predict_block(components, fitted["weights"], fitted["axes"], fitted["offset"])
        result[:, block.points] = np.asarray(predicted)[:, : len(block.points)]
    return result


def raw_label(num_lobes: int) -> str:
    return f"{count_lobes(num_lobes)}, axes as θ, φ, fit per frame"


def paper_label(num_lobes: int) -> str:
    return f"{count_lobes(num_lobes)}, axes as θ, φ, fit per frame, joint angles: the paper's way"


def count_lobes(count: int) -> str:
    return f"{count} lobe{'s' * (count > 1)}"


def refined_label(num_lobes: int, offset: bool) -> str:
    return f"{count_lobes(num_lobes)}, refined" + (" + offset" if offset else "")


def lobe_rows(ground: Ground, refined: dict[int, SH], axes: dict[int, np.ndarray]) -> Iterator[MethodRow]:
    for c in LOBE_COUNTS:
        yield method_row(ground, f"{count_lobes(c)}, axes fixed per point", 6 * c, fixed_axis_lobes(ground, axes[c]))
    for c in LOBE_COUNTS:
        yield method_row(ground, refined_label(c, ground.fit.offset), 6 * c, refined[c])


def subset_rows(
    ground: Ground,
    refined: dict[tuple[int, bool], SH],
    axes: dict[int, np.ndarray],
    joint_angles: LinearPose | None,
    track: Track,
    checkpoint: Checkpoint,
) -> list[MethodRow]:
    """From the paper's way to the refined model on the same few points and frames.

    Args:
      joint_angles: the same frames seen through joint angles, as the paper sees them.
      refined: by number of lobes and offset.
      axes: of each point, by number of lobes.
    """
    stage = checkpoint.stage("study_per_frame", ground.data, ground.linear, joint_angles, axes)
    mean = np.broadcast_to(ground.sh[ground.train].mean(0), ground.sh.shape)
    rows = [
        method_row(ground, "mean visibility", 0, mean),
        method_row(ground, "linear, 16 SH", 16, ground.linear.predict(ground.sh)),
    ]

    def per_frame(c: int) -> Arrays:
        return as_arrays(list(_rows_per_frame(ground, c, axes[c], joint_angles)))

    slow = dict(stage.parts(LOBE_COUNTS, per_frame, track=track, label="fits per frame", one_by_one=True))
    for c in LOBE_COUNTS:
        rows += [MethodRow(**row) for row in from_arrays(slow[LOBE_COUNTS.index(c)])]
        rows.append(
            method_row(ground, f"{count_lobes(c)}, axes fixed per point", 6 * c, fixed_axis_lobes(ground, axes[c]))
        )
        rows += [method_row(ground, refined_label(c, offset), 6 * c, refined[c, offset]) for offset in (False, True)]
    return rows


def _rows_per_frame(
    ground: Ground, c: int, axes: Float[np.ndarray, "n c 3"], joint_angles: LinearPose | None
) -> Iterator[MethodRow]:
    """The methods that fit c lobes to every frame on its own, which takes seconds."""
    kinds = {raw_label(c): ground.linear} | ({paper_label(c): joint_angles} if joint_angles else {})
    fitted, predicted = raw_angle_lobes(ground, c, list(kinds.values()))
    yield method_row(ground, f"{count_lobes(c)}, fit per frame, no pose model", 6 * c, fitted)
    for label, sh in zip(kinds, predicted, strict=True):
        yield method_row(ground, label, 6 * c, sh)
    yield method_row(ground, f"{count_lobes(c)}, anchored charts", 6 * c, anchored_lobes(ground, axes))
