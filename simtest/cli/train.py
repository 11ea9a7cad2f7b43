"""`simtest train`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.common import AsJson, Seed, Settings, named_path


def train(
    training: str,
    data: Path,
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for checkpoints, curves and the network.", converter=named_path)],
    seed: Seed = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train a network on a dataset; the same command goes on where it was stopped.

    Parameters
    ----------
    training : str
        A training file, or the name of a shipped one (`simtest list trainings`).
    data : Path
        Folder of the dataset.
    """
    from simtest.cli.common import print_files
    from simtest.cli.progress import progress_bar
    from simtest.dataset.learn.training import load_training
    from simtest.spec import parse_settings

    values = parse_settings(settings or []) | ({} if seed is None else {"seed": seed})
    wanted = load_training(training, values)
    # Imported late: PyTorch takes a second, and is missing where the extra is.
    from simtest.dataset.learn.runs import run_training

    with progress_bar("writing the network") as progress:
        run = run_training(wanted, data, out, progress)
    kept = run.state.history[run.state.best]
    print_files(
        run.files, as_json, training=wanted.name, epochs=len(run.state.history), best_epoch=run.state.best + 1,
        validation_loss=kept.validation_loss, **kept.metrics,
    )  # fmt: skip
