"""Images of a denoiser among the layers of a file: by the names of each renderer, and light only where it adds up."""

import numpy as np
import OpenEXR
import pytest

from jaxrender.checks import InputError
from jaxrender.io import aovs, write_exr
from jaxrender.io.layer_names import AovNames

HEIGHT, WIDTH = 5, 7


def image(rng, count=3):
    return rng.uniform(0.1, 1.0, (HEIGHT, WIDTH, count)).astype(np.float32)


def write_channels(path, names, rng):
    """A file with exactly these channels, as a renderer writes them; returns their values by name."""
    planes = {name: image(rng, 1)[..., 0] for name in names}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, dict(planes)).write(str(path))
    return planes


def channels(layer, letters):
    return [f"{layer}.{letter}" for letter in letters]


BLENDER = [
    *channels("ViewLayer.Combined", "RGBA"), *channels("ViewLayer.Noisy Image", "RGBA"),
    *channels("Composite.Combined", "RGBA"), "ViewLayer.Depth.Z", *channels("ViewLayer.Normal", "XYZ"),
    *channels("ViewLayer.Position", "XYZ"), *channels("ViewLayer.DiffCol", "RGB"),
    *channels("ViewLayer.Denoising Albedo", "RGB"), *channels("ViewLayer.Denoising Normal", "XYZ"),
    "ViewLayer.Denoising Depth.Z", *channels("ViewLayer.AO", "RGB"), *channels("ViewLayer.Emit", "RGB"),
    *channels("ViewLayer.Env", "RGB"), "ViewLayer.IndexOB.X",
]  # fmt: skip
PLAIN_BLENDER = [
    *channels("RenderLayer.Combined", "RGBA"), "RenderLayer.Depth.V", *channels("RenderLayer.Normal", "XYZ"),
]  # fmt: skip
MITSUBA = [
    *"RGBA", *channels("my_image", "RGBA"), *channels("albedo", "RGB"), *channels("nn", "XYZ"), "dd.y.T",
    *channels("pos", "XYZ"), *channels("uv", "UV"),
]  # fmt: skip
ARNOLD = [
    *"RGBA", *channels("direct", "RGB"), *channels("indirect", "RGB"), *channels("emission", "RGB"),
    *channels("background", "RGB"), *channels("diffuse_albedo", "RGB"), *channels("albedo", "RGB"),
    *channels("N", "XYZ"), *channels("P", "XYZ"), "Z", *channels("AO", "RGB"), *channels("variance", "RGB"),
]  # fmt: skip
NOICE = [
    *"RGBA", *channels("denoise_albedo_noice", "RGB"), *channels("albedo", "RGB"), *channels("N_noice", "XYZ"),
    "Z_noice", *channels("N", "XYZ"),
]  # fmt: skip
PBRT = [
    *"RGB", *channels("Albedo", "RGB"), *channels("P", "XYZ"), *"uv", "dzdx", "dzdy", *channels("N", "XYZ"),
    *channels("Ns", "XYZ"), *channels("Variance", "RGB"), *channels("RelativeVariance", "RGB"),
]  # fmt: skip
OLD_PBRT = [*"RGB", *channels("Albedo", "RGB"), "Px", "Py", "Pz", "dzdx", "dzdy", "Nx", "Ny", "Nz", "Nsx", "Nsy", "Nsz"]
OURS = [
    *"RGBA", *channels("albedo", "RGB"), *channels("normal", "RGB"), *channels("geometric_normal", "RGB"),
    *channels("position", "RGB"), "depth", *channels("uv", "XY"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (BLENDER, {"color": ["ViewLayer.Noisy Image"], "albedo": ["ViewLayer.Denoising Albedo"],
                   "normal": ["ViewLayer.Denoising Normal"], "depth": ["ViewLayer.Denoising Depth"],
                   "position": ["ViewLayer.Position"], "ao": ["ViewLayer.AO"], "emission": ["ViewLayer.Emit"],
                   "background": ["ViewLayer.Env"]}),
        (PLAIN_BLENDER, {"color": ["RenderLayer.Combined"], "normal": ["RenderLayer.Normal"],
                         "depth": ["RenderLayer.Depth"]}),
        (MITSUBA, {"color": [""], "albedo": ["albedo"], "normal": ["nn"], "depth": ["dd.y.T"], "position": ["pos"]}),
        (ARNOLD, {"color": [""], "direct": ["direct"], "indirect": ["indirect"], "emission": ["emission"],
                  "background": ["background"], "albedo": ["albedo"], "normal": ["N"], "depth": ["Z"],
                  "position": ["P"], "ao": ["AO"]}),
        (NOICE, {"color": [""], "albedo": ["denoise_albedo_noice"], "normal": ["N_noice"], "depth": ["Z_noice"]}),
        (PBRT, {"color": [""], "albedo": ["Albedo"], "normal": ["Ns"], "position": ["P"]}),
        (OLD_PBRT, {"color": [""], "albedo": ["Albedo"], "normal": ["Nsx", "Nsy", "Nsz"],
                    "position": ["Px", "Py", "Pz"]}),
        (OURS, {"color": [""], "albedo": ["albedo"], "normal": ["normal"], "depth": ["depth"],
                "position": ["position"]}),
    ],
)  # fmt: skip
def test_layers_of_renderers_are_found(names, expected, rng, tmp_path):
    planes = write_channels(tmp_path / "x.exr", names, rng)
    file = aovs.read_layered_file(tmp_path / "x.exr")
    known = AovNames(file.layers)
    found = {aov: list(known.find(aov)) for aov in aovs_of_tables()} | {"color": [known.color]}
    assert {aov: layers for aov, layers in found.items() if layers} == expected
    for aov, layers in expected.items():
        own = [planes[channel] for layer in layers for channel in file.channels[layer]]
        values = aovs.aov_image(file, aov, layers)
        expected_values = own[: values.shape[-1]]
        np.testing.assert_allclose(np.moveaxis(values, -1, 0), expected_values, rtol=1e-6)


def aovs_of_tables():
    return ("direct", "indirect", "emission", "background", "albedo", "normal", "depth", "position", "ao")


def test_view_layers_are_kept_apart(rng, tmp_path):
    """A second view layer, with fewer layers, gives nothing to the first, and everything when its picture is named."""
    names = [*channels("Sky.Combined", "RGBA"), *channels("Sky.Normal", "XYZ"), "Sky.Depth.Z"]
    names += [*channels("Body.Combined", "RGBA"), *channels("Body.Normal", "XYZ"), *channels("Body.DiffCol", "RGB")]
    names += [*channels("Body.AO", "RGB")]
    write_channels(tmp_path / "x.exr", names, rng)
    layers = aovs.read_layered_file(tmp_path / "x.exr").layers
    body, sky = AovNames(layers), AovNames(layers, color="Sky.Combined")
    assert (body.color, body.find("normal"), body.find("depth")) == ("Body.Combined", ("Body.Normal",), ())
    assert (sky.color, sky.find("normal"), sky.find("albedo")) == ("Sky.Combined", ("Sky.Normal",), ())


def test_parts_of_a_file_are_found_and_keep_their_channels(rng, tmp_path):
    """A file of several parts, as Arnold and Karma write it: the part's name is before the layer's, or is it."""
    planes = {name: image(rng, 1)[..., 0] for name in ("R", "G", "B", "N.X", "N.Y", "N.Z", "Z")}
    parts = [
        OpenEXR.Part({"name": "C"}, {name: planes[name] for name in "RGB"}),
        OpenEXR.Part({"name": "N"}, {name: planes[name] for name in ("N.X", "N.Y", "N.Z")}),
        OpenEXR.Part({"name": "depth"}, {"Z": planes["Z"]}),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    file = aovs.read_layered_file(tmp_path / "x.exr")
    names = AovNames(file.layers)
    assert (names.color, names.find("normal"), names.find("depth")) == ("", ("N.N",), ("depth.Z",))
    assert file.channels == {"": ("R", "G", "B"), "N.N": ("N.X", "N.Y", "N.Z"), "depth.Z": ("depth.Z",)}


def test_a_file_or_part_of_a_vector_alone(rng, tmp_path):
    """X, Y and Z without a name before them are one layer, and not a gray picture and a depth."""
    x, y, z, r = (image(rng, 1)[..., 0] for _ in range(4))
    vector = {"X": x, "Y": y, "Z": z}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(vector)).write(str(tmp_path / "alone.exr"))
    parts = [OpenEXR.Part({"name": "C"}, dict.fromkeys("RGB", r)), OpenEXR.Part({"name": "N"}, dict(vector))]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    alone, parted = (aovs.read_layered_file(tmp_path / f"{name}.exr") for name in ("alone", "parts"))
    np.testing.assert_array_equal(alone.layers[""], np.stack([x, y, z], axis=-1))
    np.testing.assert_array_equal(parted.layers["N"], alone.layers[""])
    assert (set(alone.layers), set(parted.layers)) == ({""}, {"", "N"})
    assert parted.channels["N"] == ("N.X", "N.Y", "N.Z") and AovNames(parted.layers).find("depth") == ()


def test_stereo_views_and_integers_are_not_taken(rng, tmp_path):
    layers = {"": image(rng, 4), "left": image(rng, 4), "left.normal": image(rng)}
    layers["depth"] = np.ones((HEIGHT, WIDTH, 1), np.uint32)
    write_exr(tmp_path / "x.exr", layers)
    names = AovNames(aovs.read_layered_file(tmp_path / "x.exr").layers)
    assert names.color == "" and names.find("normal") == names.find("depth") == ()


@pytest.mark.parametrize(
    ("reference", "path", "layer"),
    [
        ("a/b.exr", "a/b.exr", None),
        ("a/b.EXR:ViewLayer.Depth", "a/b.EXR", "ViewLayer.Depth"),
        ("a/b.exr:", "a/b.exr", ""),
        ("C:/b.exr:x:y", "C:/b.exr", "x:y"),
        ("a:b", "a:b", None),
    ],
)
def test_references_to_layers(reference, path, layer):
    found, name = aovs.split_reference(reference)
    assert (str(found), name) == (path, layer)


def test_a_file_whose_name_looks_like_a_reference(tmp_path):
    (tmp_path / "a.exr:b").touch()
    assert aovs.split_reference(str(tmp_path / "a.exr:b")) == (tmp_path / "a.exr:b", None)


def test_layers_are_picked_by_name_by_kind_or_alone(rng, tmp_path):
    write_exr(tmp_path / "many.exr", {"N": image(rng), "mask": image(rng, 1)})
    write_exr(tmp_path / "one.exr", {"shading": image(rng)})
    write_exr(tmp_path / "plain.exr", {"": image(rng), "mask": image(rng, 1)})
    many, one, plain = (aovs.read_layered_file(tmp_path / f"{name}.exr") for name in ("many", "one", "plain"))
    assert aovs.pick_layers(many, "normal") == ("N",)
    assert aovs.pick_layers(many, "normal", "mask") == ("mask",)
    assert aovs.pick_layers(one, "normal") == ("shading",)
    assert aovs.pick_layers(plain, "normal") == ("",)
    with pytest.raises(
        InputError, match=r"many\.exr: layers: expected a layer known as albedo, or :LAYER .*'N', 'mask"
    ):
        aovs.pick_layers(many, "albedo")
    with pytest.raises(InputError, match=r"many\.exr: layers: expected a layer 'x', got 'N', 'mask'"):
        aovs.pick_layers(many, "albedo", "x")


def test_channels_of_images(rng, tmp_path):
    gray, colors, alpha = image(rng, 1), image(rng), image(rng, 4)
    layers = {"gray": gray, "same": np.repeat(gray, 3, axis=-1), "colors": colors, "alpha": alpha, "two": image(rng, 2)}
    write_exr(tmp_path / "x.exr", {**layers, "whole": np.ones((HEIGHT, WIDTH, 3), np.uint32)})
    file = aovs.read_layered_file(tmp_path / "x.exr")
    np.testing.assert_array_equal(aovs.aov_image(file, "color", ["gray"]), layers["same"])
    np.testing.assert_array_equal(aovs.aov_image(file, "color", ["alpha"]), alpha[..., :3])
    np.testing.assert_array_equal(aovs.aov_image(file, "depth", ["same"]), gray)
    # Rays of three lengths; of channels that are equal one is enough.
    np.testing.assert_array_equal(aovs.aov_image(file, "ao", ["colors"]), colors)
    np.testing.assert_array_equal(aovs.aov_image(file, "ao", ["same"]), gray)
    np.testing.assert_array_equal(aovs.aov_image(file, "ao", ["gray", "same", "colors"])[..., 1:], colors)
    for aov, layer, words in [
        ("depth", "colors", "expected 1 channel, or 3 that are equal .depth., got 3 that differ"),
        ("normal", "gray", "expected 3 channels .normal., got 1"),
        ("color", "two", "expected 1, 3 or 4 channels .color., got 2"),
        ("color", "whole", "expected floating point .color., got integers .uint32."),
    ]:
        with pytest.raises(InputError, match=rf"x\.exr: layer '{layer}': {words}"):
            aovs.aov_image(file, aov, [layer])


@pytest.mark.parametrize(("name", "value"), [("samplesPerPixel", 16), ("cycles.ViewLayer.samples", "16")])
def test_samples_are_read_from_the_header(name, value, rng, tmp_path):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, name: value}
    OpenEXR.File(header, {"Y": image(rng, 1)[..., 0]}).write(str(tmp_path / "x.exr"))
    assert aovs.read_layered_file(tmp_path / "x.exr").samples_per_pixel == 16.0
    write_exr(tmp_path / "y.exr", image(rng))
    assert aovs.read_layered_file(tmp_path / "y.exr").samples_per_pixel is None


# --- Light in parts


def lit_file(path, rng, layers, **given):
    """The light that is found in a file of these layers, and the remark."""
    write_exr(path, layers, half=given.pop("half", False))
    file = aovs.read_layered_file(path)
    names = AovNames(file.layers)
    return aovs.split_light(file, names, aovs.aov_image(file, "color", [names.color]), given)


def blender_layers(rng, *, missing=()):
    lobes = {}
    for lobe in ("Diff", "Gloss", "Trans"):
        lobes |= {f"V.{lobe}{kind}": image(rng) for kind in ("Dir", "Ind", "Col")}
    lobes |= {"V.VolumeDir": image(rng), "V.VolumeInd": image(rng), "V.Emit": image(rng), "V.Env": image(rng)}
    direct, indirect = (
        sum(lobes[f"V.{lobe}{kind}"] * lobes[f"V.{lobe}Col"] for lobe in ("Diff", "Gloss", "Trans"))
        + lobes[f"V.Volume{kind}"]
        for kind in ("Dir", "Ind")
    )
    picture = direct + indirect + lobes["V.Emit"] + lobes["V.Env"]
    layers = {"V.Combined": picture, **{name: v for name, v in lobes.items() if name not in missing}}
    return layers, direct, indirect


@pytest.mark.parametrize("half", [False, True])
def test_lobes_of_blender_add_up(half, rng, tmp_path):
    layers, direct, indirect = blender_layers(rng)
    light, remark = lit_file(tmp_path / "x.exr", rng, layers, half=half)
    tolerance = 2e-3 if half else 1e-6
    assert remark == "" and light.layers == {}
    np.testing.assert_allclose(light.direct, direct, rtol=tolerance)
    np.testing.assert_allclose(light.indirect, indirect, rtol=tolerance)
    np.testing.assert_allclose(light.emission, layers["V.Emit"] + layers["V.Env"], rtol=tolerance)


def test_a_lobe_that_is_missing_makes_one_picture(rng, tmp_path):
    layers, *_ = blender_layers(rng, missing=["V.GlossInd"])
    light, remark = lit_file(tmp_path / "x.exr", rng, layers)
    assert light is None
    assert remark == (
        "the lobes of Blender do not add up to the picture (at 100 % of the pixels): it is filtered as a whole"
    )


def test_arnold_by_sums_and_by_lobes(rng, tmp_path):
    direct, indirect, emission, background = (image(rng) for _ in range(4))
    whole = {"": direct + indirect + emission, "direct": direct, "indirect": indirect}
    # A background that the picture does not contain is not taken for light in it.
    light, _ = lit_file(tmp_path / "a.exr", rng, {**whole, "emission": emission, "background": background})
    assert light.layers == {"direct": "direct", "indirect": "indirect", "emission": "emission"}
    np.testing.assert_array_equal(light.emission, emission)
    half = {f"{lobe}_{kind}": 0.5 * part for kind, part in (("direct", direct), ("indirect", indirect))
            for lobe in ("diffuse", "coat")}  # fmt: skip
    light, _ = lit_file(tmp_path / "b.exr", rng, {"": direct + indirect, **half})
    assert light.emission is None
    np.testing.assert_allclose(light.direct, direct, rtol=1e-6)
    light, remark = lit_file(tmp_path / "c.exr", rng, whole)
    assert light is None and remark.startswith("direct and indirect light do not add up")


def test_the_rest_of_indirect_light_is_direct(rng, tmp_path):
    picture, indirect = image(rng) + 1.0, image(rng)
    light, _ = lit_file(tmp_path / "x.exr", rng, {"": picture}, indirect=indirect)
    np.testing.assert_allclose(light.direct, picture - indirect, rtol=1e-6)
    light, remark = lit_file(tmp_path / "y.exr", rng, {"": picture}, indirect=indirect + 1.5)
    assert light is None and "indirect light and a direct rest do not add up" in remark


def test_broken_pixels_do_not_decide_whether_light_adds_up(rng, tmp_path):
    direct, indirect = image(rng), image(rng)
    picture = direct + indirect
    picture[0, 0], indirect[1, 1] = np.nan, np.inf
    light, _ = lit_file(tmp_path / "x.exr", rng, {"": picture, "direct": direct, "indirect": indirect})
    assert light is not None
    assert aovs.misfit_share(np.full_like(picture, np.nan), [direct]) == 1.0
    off = np.zeros_like(picture)
    off[:2] = 1.0
    assert aovs.misfit_share(direct + off, [direct]) == pytest.approx(2 / HEIGHT)
