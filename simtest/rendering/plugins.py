"""Mitsuba plugins of simtest, for scenes that Mitsuba loads without simtest (see docs/howto/scenes.md).

One line before `mi.load_file` or `mi.load_dict`, after `mi.set_variant`::

    from simtest.rendering.plugins import register; register()
"""

from simtest.errors import BackendError
from simtest.rendering import elements


def register() -> None:
    """Register the plugins for Mitsuba's active variant; call it again after a change of variant."""
    import mitsuba

    variant = mitsuba.variant()
    if variant is None:
        raise BackendError("no Mitsuba variant is set; call mitsuba.set_variant before register")
    elements.register(variant)
