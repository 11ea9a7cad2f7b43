"""`simtest dataset`: make a labelled dataset, check it, look at it."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from simtest.cli.options import Address, EngineName, Seed, Workers, named_path, replacing, whole_number

dataset = App(name="dataset", help="Make a labelled dataset for learning, check it, look at it.")

Folder = Annotated[Path, Parameter(help="The dataset's folder.", converter=named_path)]
Settings = Annotated[list[str] | None, replacing("samples_per_anatomy=5 or sensor.noise_sigma=0")]
Variant = Annotated[str | None, Parameter(help="llvm (default), cuda on an NVIDIA GPU, or a Mitsuba variant by name.")]
Samples = Annotated[int | None, Parameter(help="Number of samples; default the file's.", converter=whole_number)]


@dataset.default
def make(
    described: Annotated[str, Parameter(name="DATASET")],
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
) -> None:
    """Make a dataset: shards, tables, manifest and card; the same command goes on where it was stopped.

    Parameters
    ----------
    described : str
        A dataset file, or the name of a shipped one: endoscopy, learning, smooth, tiny.
    """
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
        gpu = variant is not None and needs_gpu(variant)
        chosen = make_engine(engine, workers, address, gpu, SHARDS_PER_PROCESS)
        write_dataset(wanted, out, chosen, variant, progress)
    print(out / "README.md")


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
) -> int:
    """Check a dataset's files and values; exit 1 if anything is broken, and name it."""
    from simtest.cli.progress import progress_bar
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS
    from simtest.dataset.verify import repair_files
    from simtest.dataset.verify import verify as check
    from simtest.runtime.engines import make_engine

    with progress_bar("done") as progress:
        faults = check(folder, progress)
        for fault in faults:
            print(fault)
        if faults and repair:
            left = repair_files(
                folder, faults, make_engine(engine, workers, address, renew_after=SHARDS_PER_PROCESS), progress
            )
            print(*(f"still broken: {fault}" for fault in left), sep="\n", end="\n" * bool(left))
            print("mended" if not left else f"left: {len(left)}")
            return 1 if left else 0
    print(f"{len(faults)} fault{'s' * (len(faults) > 1)}" if faults else "sound")
    return 1 if faults else 0


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
) -> int:
    """Make one sample of a dataset again, alone; exit 1 if it differs from the stored one.

    Parameters
    ----------
    index : int
        Of the sample, from 0.
    """
    from simtest.dataset.reproduce import compare, reproduce_sample

    target = out or Path(f"sample-{index}")
    files = reproduce_sample(folder, index, target, variant)
    print(*files, sep="\n")
    verdict = compare(folder, index, target)
    print(verdict)
    return 0 if verdict.endswith("same bytes") else 1


@dataset.command
def preview(
    folder: Folder,
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Page to write; default preview.html in the current folder.", converter=named_path)
    ] = None,
    samples: Annotated[int, Parameter(help="How many samples to show.", converter=whole_number)] = 24,
) -> None:
    """Write a page with a dataset's frames, labels, highlights and distributions."""
    from simtest.dataset.preview import write_preview
    from simtest.runtime.locks import exclusive_file

    page = out or Path("preview.html")
    with exclusive_file(page):
        print(write_preview(folder, page, samples))
