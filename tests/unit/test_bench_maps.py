"""The dense part's sums by scene, which pair two methods' maps."""

from types import SimpleNamespace

from simtest.bench.run import _scene_sums


def test_a_frame_without_a_row_moves_no_other_frame() -> None:
    """Two scenes of two frames, the first of which shows no surface; a name that stands for two equal frames is one."""

    def row(frame: str, error: float) -> dict[str, object]:
        return {"frame": frame, "setting": "plane", "source": "normal", "quantity": "angle_deg", "surface": "fine",
                "group": "zone", "label": "all", "n": 10, "mean_penalised": error}  # fmt: skip

    score = SimpleNamespace(rows=[row("b", 1.0), row("c", 5.0), row("d", 5.0)])
    numbers = {"a": 0, "b": 1, "c": 2, "d": 3}
    assert _scene_sums(score, "normal", {"plane": (2, 2)}, numbers) == {"plane": [(10, 10.0), (20, 100.0)]}
    score.rows = [row("b", 1.0), row("c", 5.0)]
    assert _scene_sums(score, "normal", {"plane": (2, 2)}, numbers) == {"plane": [(10, 10.0), (10, 50.0)]}
