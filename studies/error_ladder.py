"""Print the error ladder of docs/gallery/error_ladder.md: `python -m studies.error_ladder`; seconds."""

from itertools import groupby

from simtest.validation.error_ladder import RUNGS, error_ladder


def main() -> None:
    """Print the mean error at each rung, by scene and estimator."""
    head = ("scene", "estimator", *RUNGS)
    lines = [head, tuple("---" for _ in head)]
    for (scene, estimator), rungs in groupby(error_ladder(), lambda rung: (rung.scene, rung.estimator)):
        means = [rung.mean_deg for rung in rungs]
        lines.append((scene, estimator, *("none" if mean is None else f"{mean:.2g}" for mean in means)))
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))


if __name__ == "__main__":
    main()
