"""Ranges of numbers that several parts of a scene share."""

from typing import Annotated

from pydantic import Field

Share = Annotated[float, Field(ge=0, le=1)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Millimetres = Annotated[float, Field(ge=1e-3, le=1e6)]
Curvature = Annotated[float, Field(ge=-10, le=10)]
