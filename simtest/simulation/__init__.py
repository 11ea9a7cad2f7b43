"""A labelled frame: a rendering session, the camera chain, true highlights and viewpoints.

`rendered_view` renders a scene once for all its noise realisations: `true_highlights` judges which highlights count,
and `camera_chain` turns radiance into the sensor's frame. `labelled_frame` adds the ground truth of every pixel, and
`frame_files` writes it. `viewpoints` picks views of an anatomy that show highlights, and `view_files` writes these.
"""
