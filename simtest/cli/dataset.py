"""`simtest dataset`: make a labelled dataset, check it, look at it."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from simtest.cli.options import Address, AsJson, EngineName, Seed, Workers, named, named_path, replacing, whole_number

dataset = App(name="dataset", help="Make a labelled dataset for learning, check it, look at it.")

Folder = Annotated[Path, Parameter(help="The dataset's folder.", converter=named_path)]
Settings = Annotated[list[str] | None, replacing("samples_per_anatomy=5 or sensor.noise_sigma=0")]
Variant = Annotated[
    str | None,
    Parameter(help="llvm, cuda on an NVIDIA GPU, or a Mitsuba variant by name; default SIMTEST_VARIANT, else llvm."),
]
Samples = Annotated[int | None, Parameter(help="Number of samples; default the file's.", converter=whole_number)]


@dataset.default
def make(
    described: Annotated[str, named("datasets", files=True, name="DATASET")],
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder of the dataset; made if need be.", converter=named_path)],
    samples: Samples = None,
    seed: Seed = None,
    settings: Settings = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """Make a dataset: shards, tables, manifest and card; the same command goes on where it was stopped.

    Parameters
    ----------
    described : str
        A dataset file, or the name of a shipped one: endoscopy, highlights, highlights_smooth,
        highlights_tiny, smooth, tiny.
    """
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS, write_dataset
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.engines import make_engine
    from simtest.spec import load_dataset, parse_settings

    values = parse_settings(settings or []) | {
        key: value for key, value in (("samples", samples), ("seed", seed)) if value is not None
    }
    wanted = load_dataset(described, values)
    with progress_bar("writing the tables") as progress:
        chosen = make_engine(engine, workers, address, needs_gpu(variant), SHARDS_PER_PROCESS)
        write_dataset(wanted, out, chosen, variant, progress)
    print_files([out / "README.md"], as_json, dataset=wanted.name, samples=wanted.samples)


@dataset.command
def verify(
    folder: Folder,
    /,
    *,
    repair: Annotated[
        bool, Parameter(negative="", help="Make again what is broken; remove files that do not belong.")
    ] = False,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> int:
    """Check a dataset's files and values; exit 1 if anything is broken, and name it."""
    from simtest.cli.printing import counted, print_json, print_lines
    from simtest.cli.progress import progress_bar
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS
    from simtest.dataset.verify import repair_files
    from simtest.dataset.verify import verify as check
    from simtest.runtime.engines import make_engine

    left = None
    with progress_bar("done") as progress:
        faults = check(folder, progress)
        if not as_json:
            print_lines(list(map(str, faults)))
        if faults and repair:
            chosen = make_engine(engine, workers, address, renew_after=SHARDS_PER_PROCESS)
            left = repair_files(folder, faults, chosen, progress)
    broken = faults if left is None else left
    if as_json:
        print_json({"folder": str(folder), "sound": not broken, "repaired": left is not None,
                    "faults": faults, "left": broken})  # fmt: skip
    elif left is not None:
        print_lines([f"still broken: {fault}" for fault in left])
        print("mended" if not left else f"left: {len(left)}")
    else:
        print(counted(len(faults), "fault") if faults else "sound")
    return 1 if broken else 0


@dataset.command
def sample(
    folder: Folder,
    index: Annotated[int, Parameter(converter=whole_number)],
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder for the files; default sample-INDEX.", converter=named_path)
    ] = None,
    variant: Annotated[str | None, Parameter(help="Mitsuba variant; default the dataset's own.")] = None,
    as_json: AsJson = False,
) -> int:
    """Make one sample of a dataset again, alone; exit 1 if it differs from the stored one.

    Parameters
    ----------
    index : int
        Of the sample, from 0.
    """
    from simtest.cli.printing import print_files
    from simtest.dataset.reproduce import compare, reproduce_sample

    target = out or Path(f"sample-{index}")
    files = reproduce_sample(folder, index, target, variant)
    verdict = compare(folder, index, target)
    same = verdict.endswith("same bytes")
    print_files(files, as_json, **({"same": same, "verdict": verdict} if as_json else {}))
    if not as_json:
        print(verdict)
    return 0 if same else 1


@dataset.command
def preview(
    folder: Folder,
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Page to write; default preview.html in the current folder.", converter=named_path)
    ] = None,
    samples: Annotated[int, Parameter(help="How many samples to show.", converter=whole_number)] = 24,
    as_json: AsJson = False,
) -> None:
    """Write a page with a dataset's frames, labels, highlights and distributions."""
    from simtest.cli.printing import print_files
    from simtest.dataset.preview import write_preview
    from simtest.runtime.locks import exclusive_file

    page = out or Path("preview.html")
    with exclusive_file(page):
        print_files([write_preview(folder, page, samples)], as_json)


@dataset.command
def export(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for the frames; made if need be.", converter=named_path)],
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Export a dataset's frames without their truth, for methods that run elsewhere; `simtest score` takes answers."""
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.dataset.export import export_dataset
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS
    from simtest.runtime.engines import make_engine

    with progress_bar("writing the tables") as progress:
        chosen = make_engine(engine, workers, address, renew_after=SHARDS_PER_PROCESS)
        readme = export_dataset(folder, out, chosen, progress)
    print_files([readme], as_json)
