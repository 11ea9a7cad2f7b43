"""Highlights keep their identity over frames, move as the law says, and are born and die for a stated reason."""

import itertools
from collections import Counter

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.simulation.continuation import LOST, REACHED, Contact, Motion, follow
from simtest.simulation.rendered_view import render_view
from simtest.simulation.tracks import Tracks
from simtest.spec import load_scene, scene_from_dict
from simtest.spec.views import Moved
from tests.marked import marked

pytestmark = pytest.mark.render

LAW = 0.02
"""Largest relative difference of a highlight's motion from the law."""

SURFACES = {
    "plane": {"type": "plane", "distance_mm": 10, "tilt_deg": 15},
    "sphere": {"type": "sphere", "distance_mm": 12, "radius_mm": 5},
    "sphere inside": {"type": "sphere", "distance_mm": 8, "radius_mm": 20, "side": "inside"},
    "beyond the centre": {"type": "sphere", "distance_mm": 9, "radius_mm": 5, "side": "inside"},
    "cylinder": {"type": "cylinder", "distance_mm": 10, "radius_mm": 4, "spin_deg": 35},
    "saddle": {"type": "quadric", "distance_mm": 10, "k1_per_mm": 0.06, "k2_per_mm": -0.04, "spin_deg": 20},
    "saddle beyond": {"type": "quadric", "distance_mm": 10, "k1_per_mm": 0.06, "k2_per_mm": -0.3},
}


def scene_of(surface, **tables):
    camera = {"width": 128, "height": 128, "fx": 110.0, "fy": 110.0}
    return scene_from_dict({"surface": surface, "camera": camera, **tables})


def along(scene, shift, turn, count):
    """Return a scene's frames, each moved by the same step from the one before."""
    frames = []
    for i in range(count):
        there = Moved(translation_mm=tuple(i * np.array(shift)), rotation_deg=tuple(i * np.array(turn)))
        frames.append(scene.model_copy(update={"camera": scene.camera.model_copy(update={"moved": there})}))
    return frames


class Followed:
    """Tracks over frames, with what the law needs of each."""

    def __init__(self, frames, fine=True):
        self.tracks, self.poses, self.highlights, self.identities = Tracks(fine), [], [], []
        session = Session(frames[0])
        for scene in frames:
            view = render_view(session, scene)
            found = view.highlights if fine else view.clouds
            self.identities.append(self.tracks.add(session, found))
            self.poses.append(np.array(session.surface.model_from_camera))
            self.highlights.append(found)

    def normal(self, frame, entry):
        return self.poses[frame][:3, :3] @ self.highlights[frame][entry].normal

    def predicted(self, frame, entry, motion):
        """Return u = (I + d S)^-1 delta of theory (3.3), world frame, by the highlight's own curvatures."""
        highlight, R = self.highlights[frame][entry], self.poses[frame][:3, :3]
        first = R @ highlight.direction_min
        second = np.cross(R @ highlight.normal, first)
        return first * (first @ motion) / (1 + highlight.kd_min) + second * (second @ motion) / (1 + highlight.kd_max)

    def errors(self, change=None):
        """Return the relative differences from the law, whose two ends are averaged, of all links; and bend of each."""
        errors = []
        for track in self.tracks.tracks:
            for i, pair in enumerate(itertools.pairwise(track.entries)):
                frame = track.first_frame + i
                motion = self.poses[frame + 1][:3, 3] - self.poses[frame][:3, 3]
                motion = motion if change is None else change(motion, self.poses[frame])
                ends = [self.predicted(frame + k, entry, motion) for k, entry in enumerate(pair)]
                went = track.positions[i + 1] - track.positions[i]
                # The law is that of the motion across the sightline. Positions lie on the base, which a relief's
                # normals lean against.
                normals = [self.normal(frame + k, entry) for k, entry in enumerate(pair)]
                across = (normals[0] + normals[1]) / np.linalg.norm(normals[0] + normals[1])
                went = went - across * (across @ went)
                size = np.linalg.norm(went)
                errors.append(
                    [np.linalg.norm(went - (ends[0] + ends[1]) / 2), np.linalg.norm(ends[0] - ends[1])] / size
                )
        return np.array(errors).reshape(-1, 2)


@pytest.mark.parametrize("name", marked(SURFACES, ci=["saddle", "saddle beyond"]))
def test_a_highlight_moves_as_the_law_says(name):
    followed = Followed(along(scene_of(SURFACES[name]), (0.15, -0.1, 0.05), (0.3, -0.2, 0.5), 4))
    tracks = followed.tracks.tracks
    assert tracks[0].entries == [0, 0, 0, 0]
    assert (tracks[0].birth, tracks[0].death) == ("sequence", "sequence")
    assert followed.identities == [[0]] * 4
    assert followed.errors()[:, 0].max() < LAW


@pytest.mark.parametrize("wrong", ["inverted", pytest.param("axes", marks=pytest.mark.ci)])
def test_the_law_tells_wrong_poses(wrong):
    followed = Followed(along(scene_of(SURFACES["saddle"]), (0.15, -0.1, 0.05), (0.3, -0.2, 0.5), 3))
    if wrong == "inverted":
        errors = followed.errors(lambda motion, pose: -motion)
    else:
        errors = followed.errors(lambda motion, pose: pose[:3, :3] @ np.diag([1.0, -1, -1]) @ pose[:3, :3].T @ motion)
    assert errors[:, 0].min() > 10 * LAW


def test_several_lights_keep_apart():
    lights = [{"position_mm": [2.0, 0, 0]}, {"position_mm": [-2.0, 0.5, 0]}, {"position_mm": [0, -2.0, 0]}]
    followed = Followed(along(scene_of(SURFACES["sphere"], rig={"lights": lights}), (0.2, 0.1, 0.0), (0, 0, 0), 4))
    assert [track.light for track in followed.tracks.tracks] != []
    assert sorted(track.light for track in followed.tracks.tracks) == [0, 1, 2]
    for identities, highlights in zip(followed.identities, followed.highlights, strict=True):
        for identity, highlight in zip(identities, highlights, strict=True):
            assert followed.tracks.tracks[identity].light == highlight.light


def test_a_highlight_leaves_and_enters_by_the_border():
    frames = along(scene_of(SURFACES["plane"]), (0, 0, 0), (0.0, 8.0, 0.0), 7)
    followed = Followed([*frames, *frames[::-1]])
    first, again = followed.tracks.tracks
    assert (first.birth, first.death) == ("sequence", "frame border")
    assert (again.birth, again.death) == ("frame border", "sequence")
    assert again.first_frame > first.first_frame + len(first.entries)


def rough(seed, slope_deg=8.0, wavelength_mm=1.6):
    relief = {"seed": seed, "bands": [{"slope_deg": slope_deg, "wavelength_mm": wavelength_mm}]}
    return scene_of({"type": "plane", "distance_mm": 12, "tilt_deg": 5, "relief": relief})


def test_glints_are_born_and_merge_in_pairs():
    merged = born = links = 0
    for seed in (3, 8, 21):
        followed = Followed(along(rough(seed), (0.12, 0.05, 0.0), (0, 0, 0), 4))
        reasons = Counter((t.birth, t.death) for t in followed.tracks.tracks)
        merged += sum(count for (_, death), count in reasons.items() if death == "merged")
        born += sum(count for (birth, _), count in reasons.items() if birth == "split")
        unlisted = [t for t in followed.tracks.tracks if "not found" in (t.birth, t.death)]
        assert not unlisted
        links += len(followed.errors())
        # Between two frames the number of merged and of born glints is even.
        for frame in range(1, 4):
            ends = [
                t for t in followed.tracks.tracks if t.first_frame + len(t.entries) == frame and t.death == "merged"
            ]
            starts = [t for t in followed.tracks.tracks if t.first_frame == frame and t.birth == "split"]
            assert len(ends) % 2 == 0
            assert len(starts) % 2 == 0
    assert links > 100
    assert merged > 0
    assert born > 0


class Roof:
    """Two planes that meet at the edge x = 0, where the normal turns at once by `turn` about y."""

    deforms = False

    def __init__(self, turn):
        self.turn = turn

    def meet(self, shares, origins, directions):
        position = origins - directions * (origins[:, 2:] / directions[:, 2:])
        tilt = np.where(position[:, 0] > 0, self.turn, 0.0)
        normal = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
        plane = np.broadcast_to([0.0, 0.0, 1.0], position.shape)
        return Contact(position, normal, plane, np.zeros((len(position), 3, 3)))


def test_an_end_at_an_edge_is_not_a_merger():
    """The determinant does not change on the way to the edge: there is no fold."""
    centres = np.array([-1.0, 0.0, 10.0]), np.array([1.0, 0.0, 10.0])
    motion, start = Motion(centres, tuple(c[None] for c in centres)), np.array([[-1.0, 0.0, 0.0]])
    flat, edge = (follow(Roof(turn), motion, start, np.zeros(1, dtype=np.int64)) for turn in (0.0, 0.1))
    assert flat.end == [REACHED]
    np.testing.assert_allclose(flat.position[0], [1.0, 0.0, 0.0], atol=1e-9)
    assert edge.end == [LOST]
    assert edge.share[0] == pytest.approx(0.5, abs=0.01)


def test_glints_obey_the_law_and_the_base_has_its_own_highlight():
    # The relief turns normals and moves no points: its curvature is that of a surface up to the slope's square.
    shift = (0.002, 0.001, 0.0)
    found = [Followed(along(rough(seed, 2.0, 0.6), shift, (0, 0, 0), 2)).errors() for seed in (5, 6, 7)]
    errors, bends = np.concatenate(found).T
    assert len(errors) > 20
    # Next to a fold the motion within a step is no straight line; there the law's two ends differ.
    straight = bends < 0.05
    assert np.mean(straight) > 0.7
    assert errors[straight].max() < LAW
    base = Followed(along(rough(5), (0.15, 0.1, 0.0), (0, 0, 0), 3), fine=False)
    assert [len(track.entries) for track in base.tracks.tracks] == [3]
    assert base.errors()[:, 0].max() < LAW


def test_another_way_round_gives_the_same_links():
    frames = along(rough(13), (0.1, 0.05, 0.0), (0, 0, 0), 2)
    there, back = Followed(frames), Followed(frames[::-1])
    links = {tuple(track.entries) for track in there.tracks.tracks if len(track.entries) == 2}
    assert {tuple(track.entries[::-1]) for track in back.tracks.tracks if len(track.entries) == 2} == links


@pytest.mark.slow
@pytest.mark.parametrize("where", ["colon", "liver"])
def test_highlights_of_anatomies_obey_the_law(where):
    place = {"surface.view": "wall", "surface.path_share": 0.61} if where == "colon" else {"surface.viewpoint": 31}
    settings = {"surface.path": where, **place}
    scene = load_scene("anatomy", settings)
    followed = Followed(along(scene, (0.1, -0.05, 0.02), (0.1, 0.2, 0), 3))
    errors, bends = followed.errors().T
    assert len(errors) >= 2
    assert errors[bends < 0.1].max() < LAW
