"""The worked example of the guided filter's derivatives."""

from tests.test_examples import load


def test_the_example_learns_which_guide_to_trust(tmp_path, capsys):
    """It finds that the painted pattern says nothing about light, and denoises fresh noise better for it."""
    found = load("guided_inverse").main(tmp_path)
    assert "error after" in capsys.readouterr().out and (tmp_path / "guided_inverse.png").is_file()
    assert found["error after"] < 0.8 * found["error before"]
    assert found["eps of pattern"] > 1.0 and found["eps of depth"] < 0.1
