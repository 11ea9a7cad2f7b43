"""`simtest export`."""

from simtest.cli.options import Out, SceneName, Settings, Variant


def export(scene: SceneName, /, *, out: Out, settings: Settings = None, variant: Variant = None) -> None:
    """Write a scene as files that Mitsuba itself loads: scene.xml, and surface.ply where the surface is a mesh."""
    from simtest import api
    from simtest.spec import parse_settings

    for file in api.export(scene, out, parse_settings(settings or []), variant):
        print(file)
