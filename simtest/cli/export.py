"""`simtest export`."""

from simtest.cli.options import AsJson, Out, SceneName, Settings, Variant


def export(
    scene: SceneName, /, *, out: Out, settings: Settings = None, variant: Variant = None, as_json: AsJson = False
) -> None:
    """Write a scene as files that Mitsuba itself loads: scene.xml, and surface.ply where the surface is a mesh."""
    from simtest import api
    from simtest.cli.printing import print_files
    from simtest.spec import parse_settings

    print_files(api.export(scene, out, parse_settings(settings or []), variant), as_json)
