"""`simtest render`."""

from simtest.cli.options import AsJson, Out, SceneName, Settings, Variant


def render(
    scene: SceneName, /, *, out: Out, settings: Settings = None, variant: Variant = None, as_json: AsJson = False
) -> None:
    """Render a scene with its ground truth: frame.png, radiance.exr, truth.npz, frame.json, camera.toml.

    calibration.toml holds what reconstruction is told of frame.png: camera, response, falloff, noise, lights, distance
    and lobe, as far as the scene says that they are known; `simtest reconstruct --camera` reads it.
    """
    from simtest import api
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.runtime.locks import exclusive_folder
    from simtest.simulation.frame_files import write_frame
    from simtest.spec import parse_settings

    with exclusive_folder(out):
        try:
            with progress_bar("finding the truth") as move:
                frame = api.render(scene, parse_settings(settings or []), variant, move)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("nothing is written") from None
        print_files(write_frame(frame, out), as_json, highlights=len(frame.highlights))
