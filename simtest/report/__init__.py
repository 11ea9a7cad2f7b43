"""The report of a run: figures as PNG and one self-contained page. Never imports the renderer."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtest.report.page import write_report

__all__ = ["write_report"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from simtest.report import page

        return getattr(page, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
