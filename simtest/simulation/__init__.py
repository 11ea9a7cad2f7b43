"""A labelled frame: a rendering session, the camera chain, true highlights and viewpoints.

`frame` renders a scene once for all its noise realisations: `highlights` judges which highlights count, and `sensor`
turns radiance into the sensor's frame. A labelled frame has the ground truth of every pixel too; `frame_files` writes
it. `views` picks views of an anatomy that show highlights and writes them, `sequences` the labels of a film.
"""
