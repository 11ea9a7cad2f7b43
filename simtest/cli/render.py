"""`simtest render`."""

from simtest.cli.options import Out, SceneName, Settings, Variant


def render(scene: SceneName, /, *, out: Out, settings: Settings = None, variant: Variant = None) -> None:
    """Render a scene with its ground truth: frame.png, radiance.exr, truth.npz, frame.json, camera.toml.

    A sensor with a response, bits, saturation, vignetting or a full well also gets calibration.toml, and so does a
    light at the camera whose emission is known (rig.emission_known).
    """
    from simtest import api
    from simtest.cli.progress import progress_bar
    from simtest.runtime.files import refuse_file
    from simtest.simulation.frame_files import write_frame
    from simtest.spec import parse_settings

    refuse_file(out)
    try:
        with progress_bar("finding the truth") as move:
            frame = api.render(scene, parse_settings(settings or []), variant, move)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("nothing is written") from None
    for file in write_frame(frame, out):
        print(file)
