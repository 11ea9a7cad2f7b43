"""Bad scenes, experiments, datasets, profiles and recipes, and the commands that read them."""

from collections.abc import Iterator, Mapping

from studies.bad_inputs import files
from studies.bad_inputs.case import Case, Content, Wanted
from studies.bad_inputs.reconstruct_cases import OUTS

READERS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "render": (files.SCENE, ("render", "x.toml", "--out", "out")),
    "export": (files.SCENE, ("export", "x.toml", "--out", "out")),
    "views": (files.SCENE, ("views", "x.toml", "--out", "out")),
    "view": (files.SCENE, ("view", "x.toml", "--screenshot", "out.png")),
    "validate": (files.EXPERIMENT, ("validate", "x.toml", "--out", "out")),
    "dataset": (files.DATASET, ("dataset", "x.toml", "--out", "out")),
    "nightly": (files.PROFILE, ("nightly", "--profile", "x.toml", "--reports", "out")),
    "mesh colon": (files.COLON, ("mesh", "colon", "--recipe", "x.toml", "--out", "out.ply")),
    "mesh liver": (files.LIVER, ("mesh", "liver", "--recipe", "x.toml", "--out", "out.ply")),
    "fit": (files.DATASET, ("fit", "p.png", "--recipe", "x.toml", "--out", "out.toml")),
}
"""A good file of each command that reads one, and the command."""


def cases() -> Iterator[Case]:
    """Yield all cases of files in TOML."""
    for command in ("render", "export", "validate", "dataset"):
        yield Case(f"{command}: good", READERS[command][1], _held(command, READERS[command][0]), Wanted.DONE)
    for command in READERS:
        yield from _no_files(command)
        yield from _broken(command)
    yield from _values()
    yield from _settings()
    yield from _numbers()
    yield from _outs()


def _no_files(command: str) -> Iterator[Case]:
    good, line = READERS[command]
    for what, content in files.no_files(good):
        yield Case(f"{command}: {what}", line, _held(command, content), says="x.toml")
    named = tuple("no such name" if word == "x.toml" else word for word in line)
    yield Case(f"{command}: missing", named, _held(command, ""), says="no such name")
    long = tuple("n" * 5000 if word == "x.toml" else word for word in line)
    yield Case(f"{command}: name too long", long, _held(command, ""), says="nnn")


def _held(command: str, content: Content) -> dict[str, Content]:
    return {"x.toml": content} | ({"p.png": files.encoded(".png")} if command == "fit" else {})


def _broken(command: str) -> Iterator[Case]:
    good, line = READERS[command]
    spoilt = {
        "not TOML": "distance = = 3",
        "a table twice": good + "\n[a]\n[a]\n",
        "a key twice": "q = 1\nq = 2\n" + good,
        "unknown key": "speed = 3\n" + good,
        "unknown table": good + "\n[speed]\nx = 1\n",
        "nested deeply": good + "\nx = " + "[" * 50_000,
        "nested tables": good + "\n[" + ".".join("a" * 3000) + "]\n",
        "5000 digits": "q = " + "9" * 5000 + "\n" + good,
        "a long key": "k" * 5000 + " = 1\n" + good,
        "a line break in a key": '"a\\nb" = 1\n' + good,
        "2 MB": good + "#" * 2_000_000,
        "name a number": "name = 5\n" + good,
        "name that leaves": 'name = "../up/../../x/\\u0000"\n' + good,
        "an escape in a key": '"\\u001b[31mred" = 1\n' + good,
    }
    for what, text in spoilt.items():
        # A scene's name is shown and names no file.
        wanted = Wanted.ORDERLY if what == "name that leaves" and good == files.SCENE else Wanted.REFUSED
        yield Case(
            f"{command}: {what}", line, _held(command, text), wanted, "x.toml" if wanted is Wanted.REFUSED else ""
        )
    # A damaged file may still be good, and is then rendered: of commands that take long it must be broken.
    cut = {"validate", "nightly", "dataset", "fit", "views", "view"}
    for i, data in enumerate(files.damaged(good, 400 + len(command), 6)):
        broken = data + b"\n]" if command in cut else data
        yield Case(f"{command}: damaged {i}", line, _held(command, broken), Wanted.ORDERLY)
    for i, text in enumerate(files.damaged_words(good, 420 + len(command), 6)):
        broken_text = text + "\n]" if command in cut else text
        yield Case(f"{command}: strange words {i}", line, _held(command, broken_text), Wanted.ORDERLY)


GROUP = '[[groups]]\nscene = "plane"\n'
LONG = ", ".join(map(str, range(1, 90_001)))
HUNDREDS = "[" + ", ".join(f"{i / 7:.3f}" for i in range(433)) + "]"
MANY = "[" + ", ".join(f"{40 + i / 1000:.3f}" for i in range(433)) + "]"
THIRD = "[" + ", ".join(f"{1 + i / 1000:.3f}" for i in range(433)) + "]"


EXPERIMENTS = {
    "81 million settings": f'sweep = [{{ "surface.tilt_deg" = {HUNDREDS} }}, '
    f'{{ "reflectance.exponent" = {MANY} }}, {{ "surface.distance_mm" = {THIRD} }}]',
    "90,000 values of a sweep": f'sweep = [{{ "reflectance.exponent" = [{LONG}] }}]',
    "90,000 pooled values": f'pool = [{{ "reflectance.exponent" = [{LONG}] }}]',
    "1e6 realisations of 1e5 settings": f'realisations = 1000000\nsweep = [{{ "surface.tilt_deg" = {HUNDREDS} }}, '
    f'{{ "reflectance.exponent" = {MANY} }}]',
    "sweep of tables": 'sweep = [{ "surface" = [{ type = "cone" }] }]',
    "sweep of nested lists": 'sweep = [{ "surface.tilt_deg" = [[[[1]]]] }]',
    "sweep of NaN": 'sweep = [{ "surface.tilt_deg" = [nan] }]',
    "sweep beyond": 'sweep = [{ "a.b.c.d" = [1] }]',
    "sweep of dates": 'sweep = [{ "surface.tilt_deg" = [1979-05-27] }]',
    "drawn from nothing": 'random = { "surface.tilt_deg" = {} }',
    "unknown law": 'laws = ["gravity"]',
    "frame of 16384 x 16384 px": 'set = { "camera.width" = 16384, "camera.height" = 16384 }',
    "4096 samples a pixel": 'set = { "render.samples_per_pixel" = 5000 }',
    "a scene that is a folder": 'scene = "."',
    "a deep key": 'set = { "' + "a." * 3000 + 'b" = 1 }',
}

SCENES = {
    "width 65500": "camera.width=65500",
    "frame of 268 Mpx": "camera.width=16384 camera.height=16384",
    "width 0": "camera.width=0",
    "infinite distance": "surface.distance_mm=inf",
    "fx tiny": "camera.fx=1e-300",
    "principal point far outside": "camera.cx=9000",
    "samples": "render.samples_per_pixel=100000",
    "frame and samples": "camera.width=4000 camera.height=4000 render.samples_per_pixel=4096",
    "path depth": "render.path_depth=1000000",
    "seed": "render.seed=99999999999999999999",
    "noise": "sensor.noise_sigma=1e300",
    "exponent": "reflectance.exponent=1e300",
    "light at the surface": "rig.lights.0.position_mm=[0,0,1e9]",
    "light of nothing": "rig.lights.0.power=0",
    "fov tiny": "camera.fx=1e6",
    "lens": "camera.distortion={type='brown_conrady',k1=-100}",
    "2000 lights": "rig.lights=[" + "{}," * 2000 + "]",
    "relief of 2000 bands": "surface.relief={bands=[" + "{slope_deg=4,wavelength_mm=1}," * 2000 + "]}",
    "infinite light": "rig.lights.0.power=inf",
    "no surface in view": "surface.azimuth_deg=1e300",
}

DATASETS = {
    "samples 0": "samples=0",
    "1e12 samples": "samples=1000000000000",
    "shard_mb 0": "shard_mb=0",
    "tries": "tries=0",
    "negative seed": "seed=-1",
    "no families": "families=[]",
    "estimators a text": 'estimators="x"',
    "unknown estimator": 'estimators=["magic"]',
    "splits": "splits={train=2}",
    "highlights": "highlights=101",
}

RECIPES = {
    "length": "length_mm=1e9",
    "radius": "radius_mm=nan",
    "folds": "fold_depth_mm=30",
    "text": 'radius_mm="x"',
}


def _values() -> Iterator[Case]:
    """Yield cases of values that make no sense, or ask for too much."""
    for name, text in EXPERIMENTS.items():
        content = GROUP.replace('scene = "plane"\n', "") + text if text.startswith("scene") else GROUP + text
        says = "groups.0" if "million" in name else ""
        yield Case(f"validate: {name}", ("validate", "x.toml", "--out", "out"), {"x.toml": content}, says=says)
    # 20 groups of 5000 settings each
    groups = "".join(
        GROUP + f'label = "g{i}"\nsweep = [{{ "reflectance.exponent" = [{", ".join(map(str, range(1, 5001)))}] }}]\n'
        for i in range(20)
    )
    yield Case("validate: 20 groups of 5000 settings", ("validate", "x.toml", "--out", "out"), {"x.toml": groups})
    for name, settings in SCENES.items():
        options = [part for setting in settings.split(" ") for part in ("--set", setting)]
        yield Case(f"render: {name}", ("render", "x.toml", *options, "--out", "out"), {"x.toml": files.SCENE})
        yield Case(f"dataset: {name}", ("dataset", "x.toml", *options, "--out", "out"), {"x.toml": files.DATASET})
    for name, setting in DATASETS.items():
        options = ["--set", setting]
        yield Case(f"dataset: {name}", ("dataset", "x.toml", *options, "--out", "out"), {"x.toml": files.DATASET})
    for name, setting in RECIPES.items():
        yield Case(f"mesh colon: {name}", ("mesh", "colon", "--set", setting, "--out", "out.ply"))
    for value in ("0", "-1", "nan", "inf", "1e-3", "1e-300", "0.05", "1e300", "x"):
        yield Case(f"mesh liver: --edge-mm {value}", ("mesh", "liver", "--edge-mm", value, "--out", "out.ply"))


def _settings() -> Iterator[Case]:
    deep = ".".join("a" * 3000)
    for setting in (
        "surface.distance_mm",
        "=3",
        "",
        "surface.distance_mm=nan",
        "surface..x=1",
        ".=1",
        "a\nb",
        f"{deep}=1",
        f"surface.{deep}=1",
        "x=" + "[" * 50_000,
        "surface=5",
        "surface.type=cone",
        "rig.lights=[]",
        "rig.lights.99.power=1",
        "rig.lights.-1.power=1",
        "surface.distance_mm=" + "9" * 4400,
        "é.ü=1",
        "0=1",
        "surface.relief=" + "{a=" * 900 + "1" + "}" * 900,
    ):
        shown = setting.encode("unicode_escape").decode()[:30]
        for command in ("render", "export", "validate", "dataset", "views"):
            line = READERS[command][1]
            good = {"x.toml": READERS[command][0]}
            yield Case(f"{command}: --set {shown} ({len(setting)})", (*line, "--set", setting), good)


def _numbers() -> Iterator[Case]:
    line, good = READERS["validate"][1], {"x.toml": files.EXPERIMENT}
    for option, values in {
        "--realisations": ("0", "-1", "2.5", "x", "1e9", "99999999999999999999"),
        "--seed": ("-1", "x", "1.5", "9" * 30),
        "--workers": ("0", "-1", "257", "x", "1000000"),
        "--engine": ("mpi", ""),
        "--variant": ("magic", "", "scalar"),
        "--estimator": ("magic", "", "x" * 3000),
        "--address": ("nowhere:1",),
    }.items():
        for value in values:
            yield Case(f"validate: {option} {value[:20]}", (*line, option, value), good)
            if option not in ("--realisations", "--estimator"):
                held = {"x.toml": files.DATASET}
                yield Case(f"dataset: {option} {value[:20]}", (*READERS["dataset"][1], option, value), held)
            if option in ("--workers", "--engine", "--variant", "--address"):
                held = {"x.toml": files.PROFILE}
                yield Case(f"nightly: {option} {value[:20]}", (*READERS["nightly"][1], option, value), held)
    for value in ("0", "1001", "-1", "x", "1e3"):
        yield Case(f"views: --count {value}", ("views", "anatomy", "--count", value, "--out", "out"))
    for value in ("", "0", "0.5", "0.8,0.2", "nan,nan", "-1,2", "a,b", "0,inf", "0.2,0.2"):
        yield Case(f"views: --along {value}", ("views", "anatomy", "--along", value, "--out", "out"))
    for value in ("magic", "scalar_rgb; rm", "", "\u202e"):
        for command in ("render", "export", "doctor"):
            held = {"x.toml": files.SCENE}
            line = READERS[command][1] if command in READERS else (command,)
            yield Case(
                f"{command}: --variant {value!a}",
                (*line, "--variant", value),
                held,
                Wanted.ORDERLY if command == "doctor" else Wanted.REFUSED,
            )


def _outs() -> Iterator[Case]:
    for command in ("render", "export", "views", "validate", "dataset", "nightly", "mesh colon", "fit", "view"):
        good, line = READERS[command]
        for name, out, made in OUTS:
            # A file is what `mesh`, `fit` and `view` write.
            if (command.startswith("mesh") or command in ("fit", "view")) and name in ("a file", "FIFO"):
                continue
            held = _held(command, good) | {key.replace("__", "."): content for key, content in made.items()}
            target = out.replace("__", ".")
            yield Case(f"{command}: --out, {name}", (*line[:-1], target), held)
        if command in ("validate", "dataset"):
            held = {"x.toml": good, "out/notes.txt": "mine", "out/.hidden": "mine"}
            yield Case(f"{command}: --out, a folder of other things", line, held, says="out")
            # 20,000 files are looked at, no more than that.
            yield Case(
                f"{command}: --out, a folder of no files",
                line,
                {"x.toml": good, "out/a": files.fifo, "out/b": files.sparse(), "out/c": files.endless},
                says="out",
            )
