"""`simtest fit`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from simtest.cli.options import AsJson, Seed, named_path, whole_number

if TYPE_CHECKING:
    from simtest.realism.fitting.fit import FittedRecipe


def fit(
    frames: list[Path],
    /,
    *,
    recipe: Annotated[str, Parameter(help="A dataset file, or the name of a shipped one, whose ranges are fitted.")],
    out: Annotated[
        Path, Parameter(help="TOML file for the fitted recipe; the report stands beside it.", converter=named_path)
    ],
    scene: Annotated[
        str | None, Parameter(help="Base scene of the family that is fitted; needed where there are several.")
    ] = None,
    size: Annotated[int, Parameter(help="Frames that are rendered over the ranges.", converter=whole_number)] = 150,
    bank: Annotated[
        Path | None,
        Parameter(
            help="Folder that keeps them, for other fits too; default OUT with the suffix .bank.", converter=named_path
        ),
    ] = None,
    seed: Seed = None,
    as_json: AsJson = False,
) -> None:
    """Fit the ranges of a dataset recipe to real frames, with intervals, and say what the frames do not tell.

    Parameters
    ----------
    frames : list of Path
        Real colour frames of at least three scenes: pictures, films, or folders of pictures. A film is one scene, and
        so is a folder whose name ends in .film; any other picture is a scene of its own.
    """
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.realism.fitting.fit import fit as fitted_to
    from simtest.realism.fitting.outcome import check_out, report_json, write_fit
    from simtest.realism.fitting.parameters import one_family
    from simtest.realism.frame_sets import MOST_GENERATED, open_frames
    from simtest.runtime.limits import check_count
    from simtest.runtime.locks import exclusive_file, exclusive_folder
    from simtest.spec.recipes import load_dataset

    check_out(out)
    check_count(size, "--size", MOST_GENERATED)
    dataset = one_family(load_dataset(recipe), scene)
    opened, kept = open_frames(frames), bank or out.with_suffix(".bank")
    with exclusive_file(out), exclusive_folder(kept, "--bank"):
        with progress_bar("writing") as progress:
            found = fitted_to(opened, dataset, kept, size, seed or 0, progress)
        paths = write_fit(found, out)
    if as_json:
        print_files(paths, as_json, **report_json(found))
        return
    _print_table(found)
    print_files(paths, as_json)


def _print_table(found: "FittedRecipe") -> None:
    from simtest.cli.printing import print_lines, print_table

    rows = []
    for number, parameter in enumerate(found.parameters):
        share = found.fitted.interval[number]
        low, high = parameter.from_unit(share)
        centre = parameter.from_unit(found.fitted.centre[number])
        told = "yes" if found.fitted.told[number] else "not told"
        rows.append((parameter.kind, parameter.key, f"{centre:.3g}", f"{low:.3g} to {high:.3g}",
                     f"{share[1] - share[0]:.0%}", told))  # fmt: skip
    print_table(("parameter", "key", "centre", "95 % interval", "of its range", "told"), rows, width=140)
    print_lines([f"note: {note}" for note in found.notes()])
    print_lines([f"left out: {name}: {reason}" for name, reason in found.left_out.items()])
