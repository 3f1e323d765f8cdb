"""The examples of the documentation do what they say."""

import importlib.util
import pathlib

import pytest

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / "docs" / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_inverse_rendering_finds_pose_light_and_texture(tmp_path, capsys):
    """From 7 degrees, a light of other direction and strength, and faded paint to nearly all of it."""
    found = load("inverse_rendering").main(tmp_path)
    assert "pose after" in capsys.readouterr().out and (tmp_path / "inverse_rendering.png").is_file()
    assert found["pose before, degrees"] > 7.0 and found["pose after, degrees"] < 0.4
    assert found["light before, relative"] > 0.7 and found["light after, relative"] < 0.1
    assert found["texture after, rms"] < 0.6 * found["texture before, rms"]
    assert found["picture after, rms"] < 0.1 * found["picture before, rms"]
