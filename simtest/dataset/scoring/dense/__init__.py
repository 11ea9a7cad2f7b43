"""The dense track: maps of normals or depths, a pixel each, scored against the truth of a run or a dataset.

`map_files` reads maps, `conventions` says what their values mean, `depth` aligns depths,
`zones` and `cells` sort pixels, `tally` makes figures, `scorer` scores a frame, `score` all of them, `page`
writes the page.
`methods` holds what answers maps: a folder, or the baseline `shading`.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.dataset.scoring.dense.conventions import MapOptions
    from simtest.dataset.scoring.dense.frame_truth import FrameTruth, truth_of_view
    from simtest.dataset.scoring.dense.methods import METHODS, MapFolder, Shading, open_method
    from simtest.dataset.scoring.dense.score import DenseScore, score_frames, score_maps, write_score

__getattr__, __dir__, __all__ = lazy_names(__name__)
