"""The `jaxrender` command: reads the command line, calls one pipeline, prints the paths it wrote."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxrender import console, doctor
from jaxrender.checks import check_at_least, check_one_of

Out = Annotated[Path, tyro.conf.arg(aliases=("-o",))]


@dataclass(frozen=True)
class Demo:
    """Trains a model on the built-in character and relights it: the whole of the main job in one go."""

    out: Out = Path("out/demo")
    """Folder for the model, the pictures and the report."""
    seed: int = 0
    """Seed of everything random."""
    restart: bool = False
    """Begin anew: throw away what an earlier run left in the folder."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        from fitting.cli import run_demo  # the one place where jaxrender calls a package above it

        console.enable_compilation_cache()
        run_demo(self)


@dataclass(frozen=True)
class Relight:
    """Renders a clip of a trained character under a turning environment with self-shadows."""

    model: tyro.conf.Positional[Path | None] = None
    """A trained model (model.safetensors, or the folder it is in). Without one, the built-in character."""
    out: Out = Path("out/relight")
    """Folder for the pictures."""
    clip: str | None = None
    """Name of the clip to play. By default the first one of the model."""
    environment: Path | None = None
    """A latitude-longitude HDR map (.hdr or .exr). By default a built-in sky."""
    exponents: tuple[float, ...] = (1.0, 60.0)
    """Phong exponents: one, or the two ends of a sweep over the clip; 1 is diffuse."""
    turns: float = 1.0
    """Full turns of the environment over the clip."""
    membrane: bool = False
    """Shade as a thin translucent sheet instead of a surface."""
    truth: bool = False
    """Trace the visibility too, and show model and truth side by side (slow)."""
    size: tuple[int, int] = (512, 512)
    """Width and height of a frame in pixels."""
    azimuth_degrees: float = 25.0
    """Where the camera stands: 0 looks at the front, growing towards the character's left."""
    elevation_degrees: float = 10.0
    """Height of the camera as an angle."""
    fps: float = 24.0
    """Frames per second."""
    exr: bool = False
    """Also write each frame as a linear OpenEXR image."""
    seed: int = 0
    """Seed of everything random."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def __post_init__(self):
        if not 1 <= len(self.exponents) <= 2 or not all(0 <= e < math.inf for e in self.exponents):
            raise ValueError(f"--exponents: expected one or two numbers of at least 0, got {self.exponents}")
        if not all(1 <= side <= 8192 for side in self.size):
            raise ValueError(f"--size: expected two numbers from 1 to 8192, got {self.size}")
        if not 0 < self.fps < math.inf:
            raise ValueError(f"--fps: expected a number above 0, got {self.fps}")

    def run(self) -> None:
        from fitting.cli import run_relight

        console.enable_compilation_cache()
        run_relight(self)


@dataclass(frozen=True)
class SceneView:
    """A scene, and where it is seen from."""

    scene: tyro.conf.Positional[Path | None] = None
    """A glTF, GLB, PLY or OBJ file, or a scene.json. Without one, a built-in scene."""
    size: tuple[int, int] = (1024, 768)
    """Width and height in pixels."""
    camera: int = 0
    """Which of the file's cameras; without any, the whole scene is framed."""
    eye: tuple[float, float, float] | None = None
    """Where to look from, in the scene's units; then --target says where to."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What to look at, if --eye is given."""
    inside: bool = False
    """Look from inside the scene along its longer side, as in a building."""
    fov_degrees: float = 60.0
    """Vertical field of view, with --eye or --inside."""

    def check(self) -> None:
        """Raises ValueError, naming the option; here, and not when made, so that it is told in one line."""
        if self.eye is not None and (self.inside or not all(map(math.isfinite, (*self.eye, *self.target)))):
            raise ValueError("--eye, --target: expected finite numbers, and not --inside as well")
        if self.eye is not None and self.eye == self.target:
            raise ValueError("--target: expected another point than --eye")
        if min(self.size) < 1:
            raise ValueError(f"--size: expected two numbers of 1 or more, got {self.size[0]} {self.size[1]}")
        check_at_least("--camera", self.camera, 0)
        if not 0.0 < self.fov_degrees < 180.0:
            raise ValueError(f"--fov-degrees: expected an angle between 0 and 180, got {self.fov_degrees}")


@dataclass(frozen=True)
class SampledView(SceneView):
    """What the commands that rasterise are told."""

    samples: int = 1
    """Samples a pixel: 1, 2, 4, 8 or 16."""

    def check(self) -> None:
        """As `SceneView.check`."""
        super().check()
        check_one_of("--samples", self.samples, (1, 2, 4, 8, 16))


@dataclass(frozen=True)
class Render(SampledView):
    """Renders a scene by rasterisation and deferred shading: a PNG, and with --exr the G-buffer as layers."""

    out: Out = Path("out/render.png")
    """The picture; with --exr a file of the same name ending in .exr is written beside it."""
    samples: int = 4
    """Samples a pixel: 1, 2, 4, 8 or 16, all shaded."""
    adaptive: int | None = None
    """Adaptive supersampling at M x M samples a pixel, instead of --samples; also writes a map of the counts."""
    method: Literal["clusters", "printed", "uniform", "full"] = "clusters"
    """With --adaptive, which samples are shaded: unlike ones, those of the paper's metrics, --count of each, or all."""
    count: int = 4
    """With --method uniform: samples a pixel."""
    budget: float | None = None
    """With --adaptive: the share of the samples to shade, 0 to 1; the constants are scaled until it fits."""
    psnr: float | None = None
    """With --adaptive: how near to full supersampling to come, in dB; the constants are scaled until it is reached."""
    environment: Path | None = None
    """A lat-long .hdr or .exr map that lights the scene, beside the lights of the file."""
    model: Literal["metallic_roughness", "phong", "lambert"] = "metallic_roughness"
    """How surfaces reflect."""
    transparency: Literal["test", "coverage", "none"] = "test"
    """What alpha means: discard masked texels, or a share of the samples (blended materials as well), or nothing."""
    exposure_stops: float = 0.0
    """Brightens the PNG by powers of two."""
    exr: bool = False
    """Also write linear radiance, albedo, normals, position, depth, uv and ids as layers of an OpenEXR file; with
    --adaptive, radiance and sample counts."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        from jaxrender.render_command import run_render

        self.check()
        self.check_adaptive()
        console.enable_compilation_cache()
        run_render(self)

    def check_adaptive(self) -> None:
        """Raises ValueError, naming the option, if those of --adaptive do not fit together."""
        dials = [name for name in ("budget", "psnr") if getattr(self, name) is not None]
        if self.adaptive is None:
            if dials or self.method != "clusters":
                raise ValueError(f"--{(dials or ['method'])[0]}: expected --adaptive M beside it, got none")
            return
        if not 1 <= self.adaptive <= 8:
            raise ValueError(f"--adaptive: expected a number from 1 to 8, got {self.adaptive}")
        if dials and (len(dials) > 1 or self.method not in ("clusters", "printed")):
            raise ValueError(f"--{dials[0]}: expected it alone, with --method clusters or printed")
        if self.budget is not None and not 0.0 < self.budget <= 1.0:
            raise ValueError(f"--budget: expected a share above 0 and up to 1, got {self.budget}")
        if self.psnr is not None and not 0.0 < self.psnr <= 200.0:
            raise ValueError(f"--psnr: expected decibels above 0 and up to 200, got {self.psnr}")
        if self.method == "uniform" and not 1 <= self.count <= self.adaptive**2:
            raise ValueError(f"--count: expected a number from 1 to {self.adaptive**2}, got {self.count}")


@dataclass(frozen=True)
class Quads(SampledView):
    """Shows what shading in 2x2 quads costs for a scene: helper lanes, overdraw, warps, lockstep, in numbers and maps.

    All quads are those of a forward renderer without a depth test; the visible ones are left after a perfect early
    depth test.
    """

    out: Out = Path("out/quads")
    """Folder for the pictures."""
    json: bool = False
    """Print one JSON object instead of the tables and the list of files."""

    def run(self) -> None:
        from jaxrender.quads_command import run_quads

        self.check()
        console.enable_compilation_cache()
        run_quads(self)


@dataclass(frozen=True)
class Trace(SceneView):
    """Path-traces a scene: direct and indirect light apart, the indirect filtered by what the surfaces look like.

    Writes the picture as PNG; with --exr also as EXR with its parts, and beside it the unfiltered light with all the
    layers that `jaxrender denoise` wants. A scene without lights gets a sun and a sky.
    """

    out: Out = Path("out/trace.png")
    """The picture; with --frames each has its number before the ending."""
    spp: int = 4
    """Samples a pixel: eye rays, and paths of indirect light."""
    bounces: int = 2
    """Bounces of indirect light; 0 leaves direct light alone."""
    light_samples: int = 1
    """Shadow rays of each eye ray to lamps, and to the sky."""
    filter: Literal["guided", "bilateral", "atrous", "none"] = "guided"
    """What cleans the indirect light."""
    radius: int | None = None
    """Of the filter, in pixels. By default a rule in samples and resolution."""
    eps: float | None = None
    """Of the filter: factor on what tells edges from noise. By default a rule."""
    auto: bool | None = None
    """Find radius and eps by cross-validation. By default from 16 samples on, but not with --frames."""
    direct: Literal["auto", "ratio", "plain"] = "auto"
    """Soft shadows: unshadowed light times a filtered ratio, or plain samples. By default the ratio up to 31 rays."""
    model: Literal["metallic_roughness", "phong", "lambert"] = "metallic_roughness"
    """How surfaces reflect."""
    rays: Literal["auto", "embree", "jax"] = "auto"
    """Who traces rays: Embree on the CPU, or the tree in JAX on its device. By default Embree unless JAX has a GPU."""
    environment: Path | None = None
    """A lat-long .hdr or .exr map that lights the scene, beside the lights of the file."""
    time: float | None = None
    """Instead of --spp: seconds; the picture is written again each time its samples have doubled."""
    ground: bool = False
    """Put a matt plane under the scene, at the lowest point of its motion."""
    frames: int = 1
    """Number of frames; more than one wants --clip, --orbit-degrees, --turn-light-degrees or --new-seeds."""
    clip: str | None = None
    """Name or number of a clip of the file, to be played, over and over; one that is not there lists those that are."""
    fps: float = 24.0
    """With --clip: frames per second."""
    start_seconds: float = 0.0
    """With --clip: the clip's time in the first frame."""
    orbit_degrees: float = 0.0
    """How far the camera goes round what it looks at, over all frames."""
    turn_light_degrees: float = 0.0
    """How far sun and environment turn about the vertical, over all frames."""
    seed: int = 0
    """Of all random numbers: the same for all frames, as still noise disturbs less."""
    new_seeds: bool = False
    """Another seed for each frame."""
    exposure_stops: float = 0.0
    """Brightens the PNG by powers of two."""
    exr: bool = False
    """Also write linear light and layers as OpenEXR files."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        self.check()
        from jaxrender.trace_command import run_trace

        console.enable_compilation_cache()
        run_trace(self)

    def check(self) -> None:
        """As `SceneView.check`."""
        super().check()
        for name, value, low in (("spp", self.spp, 1), ("bounces", self.bounces, 0), ("frames", self.frames, 1),
                                 ("light-samples", self.light_samples, 1), ("radius", self.radius, 1)):  # fmt: skip
            if value is not None:
                check_at_least(f"--{name}", value, low)
        for name, number in (("time", self.time), ("eps", self.eps)):
            if number is not None and not 0.0 < number < math.inf:
                raise ValueError(f"--{name}: expected a finite number above 0, got {number}")
        if not 0 <= self.seed < 2**31 - self.frames:
            raise ValueError(f"--seed: expected a number from 0 to {2**31 - 1}, less the frames, got {self.seed}")
        if self.bounces > 64:
            raise ValueError(f"--bounces: expected at most 64, got {self.bounces}")
        if self.time is not None and self.frames > 1:
            raise ValueError("--time: expected it without --frames")
        for name, number in (("orbit-degrees", self.orbit_degrees), ("turn-light-degrees", self.turn_light_degrees)):
            if not math.isfinite(number):
                raise ValueError(f"--{name}: expected a finite number, got {number}")
        if not 0.0 < self.fps < math.inf:
            raise ValueError(f"--fps: expected a finite number above 0, got {self.fps}")
        if not 0.0 <= self.start_seconds < math.inf:
            raise ValueError(f"--start-seconds: expected a finite number >= 0, got {self.start_seconds}")
        moves = self.clip is not None or self.orbit_degrees or self.turn_light_degrees or self.new_seeds
        if self.frames > 1 and not moves:
            expected = "--clip, --orbit-degrees, --turn-light-degrees or --new-seeds beside it"
            raise ValueError(f"--frames: expected {expected}, got none, so that all frames would be one picture")
        if not -64.0 <= self.exposure_stops <= 64.0:
            raise ValueError(f"--exposure-stops: expected a number from -64 to 64, got {self.exposure_stops}")


@dataclass(frozen=True)
class Denoise:
    """Cleans a noisy rendering: an EXR file of any renderer, guided by its normals, depth, albedo and so on.

    Writes the clean picture as EXR with the other layers as they came, as PNG, and a page with before and after. Layers
    are found by the names that Blender, Mitsuba, Arnold and pbrt give them. Options that name an image take FILE or
    FILE:LAYER. Direct and indirect light are filtered apart if they add up to the picture.
    """

    noisy: tyro.conf.Positional[str | None] = None
    """The noisy picture, FILE or FILE:LAYER. Without one, a noisy picture of a built-in scene."""
    out: Out = Path("out/denoise.exr")
    """The clean picture; .png and .html files are written beside it."""
    color: str | None = None
    """The noisy picture, as an option."""
    normal: str | None = None
    """Normals."""
    depth: str | None = None
    """Depth."""
    position: str | None = None
    """Positions."""
    albedo: str | None = None
    """Albedo: it is divided out while the light is filtered."""
    ao: str | None = None
    """Ambient occlusion."""
    direct: str | None = None
    """Direct light, albedo included."""
    indirect: str | None = None
    """Indirect light, albedo included; the rest of the picture is direct if it is not given."""
    emission: str | None = None
    """Light of lamps and background that are seen themselves."""
    method: Literal["guided", "bilateral", "atrous"] = "guided"
    """The filter."""
    radius: int | None = None
    """Of the filter, in pixels. By default a rule in samples."""
    eps: float | None = None
    """Of the filter: factor on what tells edges from noise. By default a rule."""
    spp: float | None = None
    """Samples a pixel of the picture, for those rules. By default as the file says, if it does."""
    auto: bool = False
    """Choose radius and eps from the picture alone, by leave-one-out cross-validation; for frames, from the first.
    Where neighbouring pixels share noise, as after a renderer's pixel filter, it goes by the rule and says so."""
    firefly: float | Literal["off"] = 16.0
    """Pixels brighter than this many times their neighbourhood are clamped to that; off leaves them."""
    demodulate: bool = True
    """Divide the albedo out while filtering."""
    whole: bool = False
    """Filter all light, also where direct and indirect light are separate; else direct light stays as it came there."""
    keep_lamps: bool = True
    """Leave pixels as they are that seem to show a lamp itself: bright patches without noise."""
    frames: str | None = None
    """Numbers of frames, such as 1-24 or 1,3,5-7; names then have a place for them, as noisy.####.exr or %04d."""
    resume: bool = False
    """With --frames: leave out those whose output is there."""
    half: bool = False
    """Store half floats."""
    exposure_stops: float = 0.0
    """Brightens PNG and page by powers of two."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        self.check()
        from jaxrender.denoise_command import run_denoise

        console.enable_compilation_cache()
        run_denoise(self)

    def check(self) -> None:
        """Raises ValueError, naming the option; here, and not when made, so that it is told in one line."""
        if self.noisy is not None and self.color is not None:
            raise ValueError("--color: expected it alone, got it beside a picture")
        images = ("normal", "depth", "position", "albedo", "ao", "direct", "indirect", "emission")
        beside = [name for name in images if getattr(self, name) is not None]
        if beside and self.noisy is None and self.color is None:
            raise ValueError(f"--{beside[0]}: expected a noisy picture beside it, got none")
        if self.resume and self.frames is None:
            raise ValueError("--resume: expected --frames beside it, got none")
        if self.radius is not None:
            check_at_least("--radius", self.radius, 1)
        for name, value, low in (("eps", self.eps, 0.0), ("spp", self.spp, 0.0), ("firefly", self.firefly, 1.0)):
            if isinstance(value, float) and not low < value < math.inf:
                raise ValueError(f"--{name}: expected a finite number above {low:g}, got {value}")
        if not -64.0 <= self.exposure_stops <= 64.0:
            raise ValueError(f"--exposure-stops: expected a number from -64 to 64, got {self.exposure_stops}")


@dataclass(frozen=True)
class Doctor:
    """Says what is installed, what it runs on, and what each missing extra would add.

    Exit status 1 if something keeps other commands from working.
    """

    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        found = doctor.examine()
        found["problems"] = doctor.problems(found)
        if self.json:
            console.print_json(found)
        else:
            _print_findings(found)
        if found["problems"]:
            raise SystemExit(1)


def main(argv: list[str] | None = None) -> int:
    """The console script; returns the exit status."""
    argv = sys.argv[1:] if argv is None else argv
    if argv == ["--version"]:
        print(f"jaxrender {doctor.package_version('jaxrender')}")
        return 0
    description = "Real-time rendering methods as pure tensor kernels."
    commands = Demo | Render | Trace | Denoise | Quads | Relight | Doctor
    return console.run_command(
        lambda: console.parse(commands, prog="jaxrender", description=description, argv=argv).run()
    )


def _print_findings(found: dict) -> None:
    machine, cache, rays = (found[name] for name in ("machine", "compilation_cache", "rays"))
    memory = console.format_bytes(machine["memory_bytes"]) if machine["memory_bytes"] else "unknown"
    devices = [f"{device['platform']} ({device['kind']})" for device in found["devices"]["devices"]]
    programs = f"{cache['programs']} programs, {console.format_bytes(cache['bytes'])}"
    print("Machine")
    _print_pairs(
        {
            "system": machine["system"],
            "processor": f"{machine['cpu']}, {machine['cores']} cores",
            "memory": memory,
            "devices": ", ".join(devices) or "none",
            "rays": f"{rays['backend']}, {rays['threads']} threads" if rays["works"] else "none",
            "compiled programs": f"{cache['path']} ({programs})",
        }
    )
    print("\nVersions")
    packages = {name: version or "missing" for name, version in found["packages"].items()}
    _print_pairs({"python": found["python"], **packages})
    print("\nExtras (install them in the project's folder)")
    for extra in found["extras"]:
        missing = ", ".join(extra["missing"])
        state = f"missing: {missing}; {extra['install']}" if missing else "installed"
        print(f"  {extra['name']}: {extra['adds']}\n    {state}")
    print()
    for line in found["problems"]:
        print(f"Problem: {line}")
    if not found["problems"]:
        print("All is well.")


def _print_pairs(pairs: dict[str, str]) -> None:
    width = max(map(len, pairs))
    for name, value in pairs.items():
        print(f"  {name:{width}}  {value}")


if __name__ == "__main__":
    sys.exit(main())
