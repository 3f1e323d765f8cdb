"""glTF animations -> clips."""

from typing import Any, get_args

import numpy as np

from jaxrender.animation.skeleton import Channel, Clip, Interpolation, Path
from jaxrender.io.gltf_accessors import read_floats
from jaxrender.io.gltf_container import Container, printable
from jaxrender.io.gltf_nodes import unit_quaternions

_COMPONENTS = {"translation": 3, "rotation": 4, "scale": 3}


def read_clips(source: Container, joint_of: dict[int, int], *, leave_out_morphs: bool = False) -> tuple[Clip, ...]:
    """All clips, of the channels that move a joint of the skeleton; clips without any are left out.

    Args:
      joint_of: from node to joint, for the nodes in the skeleton.
      leave_out_morphs: of channels of morph weights, which are refused otherwise, leave a note.
    """
    clips: dict[str, Clip] = {}
    for i, animation in enumerate(source.gltf.animations):
        channels = tuple(_read_channels(source, animation, joint_of, leave_out_morphs, f"animations[{i}]"))
        if not channels:
            source.note("clips that move nothing left out")
            continue
        start = min(float(channel.times[0]) for channel in channels)
        end = max(float(channel.times[-1]) for channel in channels)
        name = printable(animation.name or f"clip_{i}")
        while name in clips:
            name = f"{name}_{i}"
        clips[name] = Clip(name, channels, start, end - start)
    return tuple(clips.values())


def _read_channels(
    source: Container, animation: Any, joint_of: dict[int, int], leave_out_morphs: bool, where: str
) -> list[Channel]:
    channels: list[Channel] = []
    seen: set[tuple[int, str]] = set()
    for i, channel in enumerate(animation.channels):
        field = f"{where}.channels[{i}]"
        target = channel.target
        if target is None or target.node is None:
            source.note("animation channels without a node left out")
            continue
        source.item("nodes", target.node, f"{field}.target.node")
        joint = joint_of.get(target.node)
        if joint is None:
            continue
        if target.path == "weights" and leave_out_morphs:
            source.note("channels of morph weights left out")
            continue
        if target.path not in _COMPONENTS:
            expected = "translation, rotation or scale (morph weights are not supported)"
            source.bad(f"{field}.target.path", expected=expected, got=target.path)
        if (joint, target.path) in seen:
            source.bad(f"{field}.target", expected="one channel a node and path", got="a second one")
        seen.add((joint, target.path))
        index, samplers = channel.sampler, animation.samplers
        if index is None or not 0 <= index < len(samplers):
            source.bad(f"{field}.sampler", expected=f"an index into {len(samplers)} samplers", got=index)
        channels.append(_read_sampler(source, samplers[index], joint, target.path, f"{where}.samplers[{index}]"))
    return channels


def _read_sampler(source: Container, sampler: Any, joint: int, path: Path, where: str) -> Channel:
    interpolation: Interpolation = sampler.interpolation or "LINEAR"
    if interpolation not in get_args(Interpolation):
        source.bad(f"{where}.interpolation", expected="STEP, LINEAR or CUBICSPLINE", got=interpolation)
    times = read_floats(source, sampler.input, ("SCALAR",), f"{where}.input")[:, 0]
    size = _COMPONENTS[path]
    values = read_floats(source, sampler.output, (f"VEC{size}",), f"{where}.output")
    rows_a_key = 3 if interpolation == "CUBICSPLINE" else 1
    if len(values) != rows_a_key * len(times):
        expected = f"{rows_a_key} values for each of {len(times)} keys"
        source.bad(f"{where}.output", expected=expected, got=f"{len(values)} values")
    values = values.reshape(-1, rows_a_key, size)
    if path == "rotation":
        middle = values[:, rows_a_key // 2]
        values[:, rows_a_key // 2] = unit_quaternions(source, middle, f"{where}.output")
    if (np.diff(times) < 0).any():
        source.bad(f"{where}.input", expected="increasing times", got=f"{times[1:][np.diff(times) < 0][0]} too late")
    # Of keys at one time the last one counts.
    keep = np.append(np.diff(times) > 0, True)
    source.note("animation keys at the time of the next key dropped", int((~keep).sum()))
    values = values[keep] if interpolation == "CUBICSPLINE" else values[keep, 0]
    return Channel(joint, path, interpolation, times[keep], values)
