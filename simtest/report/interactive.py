"""Draws the same figures with plotly, as JSON that the page's script turns into figures."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go

from simtest.pages import style
from simtest.pages.html import script_text
from simtest.pages.style import LIGHT, NEUTRAL, Array
from simtest.report.curves import Curve
from simtest.report.series import LineFigure
from simtest.report.static import has_law, heat_range, log_range, segment_colour, visible
from simtest.report.surface3d import Segments, Surface3D
from simtest.report.tables import HeatMap, SurfaceFigure

_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"


def to_json(figure: go.Figure) -> str:
    """Write a figure as JSON that may stand inside a script element."""
    return script_text(str(figure.to_json()))


def layout(height: int, **more: Any) -> dict[str, Any]:
    """Give the layout that all figures share, of a height in px, with more of its keys."""
    return {
        "height": height, "autosize": True, "margin": {"l": 62, "r": 12, "t": 10, "b": 56},
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "template": "none",
        "font": {"family": _FONT, "size": 13}, "hovermode": "closest",
        "legend": {"orientation": "h", "yanchor": "top", "y": -0.18, "x": 0, "xanchor": "left"}, **more,
    }  # fmt: skip


def _log_axis(title: str, arrays: Sequence[Array]) -> dict[str, Any]:
    low, high = log_range(arrays)
    return {"title": {"text": escape(title)}, "type": "log", "range": [np.log10(low), np.log10(high)], "dtick": 1,
            "exponentformat": "none", "minor": {"ticks": "outside", "ticklen": 3}, "automargin": True}  # fmt: skip


def lines(data: LineFigure, colours: Mapping[str, str]) -> go.Figure:
    """Draw curves with intervals and laws; colour is the estimator, the marker is the label."""
    figure = go.Figure()
    marks = style.symbols(data.labels)
    named: set[str] = set()
    for curve in data.curves:
        colour = colours[curve.estimator]
        if has_law(curve, data.y):
            figure.add_trace(_law_trace(data, curve, NEUTRAL if data.shared_law else colour))
        figure.add_trace(_points_trace(data, curve, colour, marks[curve.label].plotly, named))
    if any(has_law(curve, data.y) for curve in data.curves):
        line = {"color": NEUTRAL, "dash": "dash", "width": 1.5}
        figure.add_trace(go.Scatter(x=[None], y=[None], mode="lines", line=line, name=data.law_name, hoverinfo="skip"))
    x_values = np.concatenate([curve.x for curve in data.curves])
    ticks = data.x.ticks(x_values)
    x: dict[str, Any] = {"title": {"text": escape(data.x.title)}, "zeroline": False, "automargin": True}
    if ticks:
        x |= {"tickvals": ticks[0], "ticktext": ticks[1], "tickangle": 0}
    y = {"title": {"text": escape(data.y.title)}, "range": data.y.limits, "automargin": True}
    if data.y.scale == "log":
        y = _log_axis(data.y.title, [v for c in data.curves for v in (c.y, c.low, c.high)])
    figure.update_layout(layout(500, xaxis=x, yaxis=y))
    return figure


def _law_trace(data: LineFigure, curve: Curve, colour: str) -> go.Scatter:
    return go.Scatter(
        x=data.x.place(curve.law_x), y=visible(curve.law_y, data.y), customdata=curve.law_x,
        mode="lines" if curve.joined else "markers", line={"color": colour, "dash": "dash", "width": 1.5},
        marker={"symbol": "line-ew-open", "color": colour, "size": 9}, legendgroup=escape(curve.estimator),
        showlegend=False, hovertemplate=f"law, {escape(curve.label)}<br>%{{customdata:.3g}}: %{{y:.3g}}<extra></extra>",
    )  # fmt: skip


def _points_trace(data: LineFigure, curve: Curve, colour: str, symbol: str, named: set[str]) -> go.Scatter:
    first = curve.estimator not in named
    named.add(curve.estimator)
    unit = "" if data.shared_law else "°"
    texts = [
        f"<b>{escape(curve.estimator)}</b>, {escape(curve.label)}<br>{escape(name)}<br>x = {style.number(x)}, "
        f"mean {style.number(y)}{unit} [{style.number(low)}, {style.number(high)}]<br>law {style.number(law)}, "
        f"{count} rows"
        for name, x, y, low, high, law, count in zip(
            curve.names, curve.x, curve.y, curve.low, curve.high, curve.law_at, curve.counts, strict=True
        )
    ]
    return go.Scatter(
        x=data.x.place(curve.x), y=visible(curve.y, data.y), mode="lines+markers" if curve.joined else "markers",
        line={"color": colour, "width": 0.7}, marker={"symbol": symbol, "size": 8, "color": colour},
        error_y={"type": "data", "symmetric": False, "array": np.nan_to_num(curve.high - curve.y),
                 "arrayminus": np.nan_to_num(curve.y - curve.low), "color": colour, "thickness": 1.2, "width": 3},
        name=escape(curve.estimator), legendgroup=escape(curve.estimator), showlegend=first,
        text=texts, hovertemplate="%{text}<extra></extra>",
    )  # fmt: skip


def heat_map(item: HeatMap, maps: Sequence[HeatMap]) -> go.Figure:
    """Draw one heat map on the colour scale that all of them share."""
    low, high = np.log10(heat_range(maps))
    with np.errstate(divide="ignore"):
        cells = np.where(item.mean_deg > 0, np.log10(np.maximum(item.mean_deg, 1e-12)), np.nan)
    texts = [[style.number(float(v), 2) if np.isfinite(v) else "–" for v in row] for row in item.mean_deg]
    hover = [
        [f"k d {x}, ε/d {y}<br>mean {t}°<br>{n} rows" for x, t, n in zip(item.column_names, *row, strict=True)]
        for y, *row in zip(item.row_names, texts, item.counts, strict=True)
    ]
    bar = _degree_ticks(float(low), float(high))
    figure = go.Figure(
        go.Heatmap(
            z=cells, zmin=low, zmax=high, colorscale=style.SEQUENTIAL, text=texts, texttemplate="%{text}",
            customdata=hover, hovertemplate="%{customdata}<extra></extra>", xgap=1, ygap=1,
            colorbar={"title": {"text": "deg"}, "thickness": 12, **bar},
        )
    )  # fmt: skip
    axes = {"showgrid": False, "zeroline": False, "automargin": True}
    figure.update_layout(
        layout(
            360,
            xaxis=axes | {"title": {"text": "k d"}, "tickvals": list(range(len(item.kd))),
                          "ticktext": item.column_names},
            yaxis=axes | {"title": {"text": "ε/d"}, "tickvals": list(range(len(item.eps_over_d))),
                          "ticktext": item.row_names},
        )
    )  # fmt: skip
    return figure


def _degree_ticks(low: float, high: float) -> dict[str, Any]:
    values = [v for e in range(-6, 4) for v in (10.0**e, 3 * 10.0**e) if low <= np.log10(v) <= high]
    return {"tickvals": [float(np.log10(v)) for v in values], "ticktext": [f"{v:g}" for v in values]}


def surfaces(data: SurfaceFigure, colours: Mapping[str, str]) -> go.Figure:
    """Draw boxes and points of the errors per surface."""
    figure = go.Figure()
    named: set[str] = set()
    for box in data.boxes:
        name, colour = escape(box.estimator), colours[box.estimator]
        figure.add_trace(
            go.Box(
                x=[box.place], q1=[box.q1], median=[box.median], q3=[box.q3], lowerfence=[box.low],
                upperfence=[box.high], width=box.width, name=name, legendgroup=name, hoverinfo="y",
                line={"color": colour, "width": 1.4}, showlegend=box.estimator not in named,
            )
        )  # fmt: skip
        named.add(box.estimator)
        figure.add_trace(
            go.Scatter(
                x=box.points_place, y=box.points, mode="markers", legendgroup=name, showlegend=False,
                marker={"color": colour, "size": 4, "opacity": 0.5}, name=name,
                hovertemplate=f"{name}, {escape(box.surface)}<br>%{{y:.3g}}°<extra></extra>",
            )
        )  # fmt: skip
    x = {
        "tickvals": list(range(len(data.surfaces))), "ticktext": [escape(s) for s in data.surfaces],
        "range": [-0.6, len(data.surfaces) - 0.4], "zeroline": False, "showgrid": False, "automargin": True,
    }  # fmt: skip
    y = _log_axis("angular error (deg)", [box.points for box in data.boxes])
    figure.update_layout(layout(460, xaxis=x, yaxis=y, boxmode="overlay"))
    return figure


def surface_3d(data: Surface3D, colours: Mapping[str, str]) -> go.Figure:
    """Draw the surface with its normals, coloured by curvature or shaded by the frame; it can be turned and zoomed."""
    x, y, z = data.vertices.T.astype(np.float32)
    i, j, k = data.triangles.T.astype(np.int32)
    surfaces = [
        {
            "intensity": np.sqrt(data.intensity).astype(np.float32), "cmin": -0.35, "cmax": 1, "colorscale": "gray",
            "showscale": False, "lighting": {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0, "roughness": 1.0},
        }
    ]  # fmt: skip
    if data.curvature is not None:
        title = f"curvature of<br>larger size (1/{data.unit}),<br>convex positive"
        bar = {"title": {"text": title, "font": {"size": 12}}, "thickness": 12, "len": 0.6, "x": 1.0}
        limit = data.curvature_limit
        surfaces.append(
            {
                "intensity": data.curvature.astype(np.float32), "cmin": -limit, "cmax": limit, "colorscale": "RdBu",
                "reversescale": True, "colorbar": bar, "lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0.0},
            }
        )  # fmt: skip
    figure = go.Figure()
    for number, more in enumerate(surfaces):
        last = number == len(surfaces) - 1
        figure.add_trace(
            go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, flatshading=False, name="surface", hoverinfo="skip", visible=last)
            .update(more)
        )  # fmt: skip
    for part in data.segments:
        figure.add_trace(_segments(part, colours))
    figure.add_trace(_marks("camera", np.zeros((1, 3)), NEUTRAL, "diamond"))
    if len(data.lights):
        figure.add_trace(_marks("light", data.lights, LIGHT, "circle"))
    scene = {
        "aspectmode": "data",
        "camera": {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 1.25, "y": -0.95, "z": -1.4}},
        **{f"{a}axis": {"title": {"text": f"{a} ({data.unit})"}, "nticks": 5} for a in "xyz"},
    }  # fmt: skip
    figure.update_layout(layout(560, scene=scene, dragmode="orbit"))
    figure.update_layout(margin={"l": 0, "r": 0, "t": 0, "b": 0}, legend={"y": 0})
    if len(surfaces) > 1:
        figure.update_layout(updatemenus=[_choice(["curvature", "picture"])])
    return figure


def _choice(names: Sequence[str]) -> dict[str, Any]:
    """Give the buttons that show one of the two surfaces, the traces 1 and 0."""
    shown = ([False, True], [True, False])
    buttons = [
        {"label": name, "method": "restyle", "args": [{"visible": which}, [0, 1]]}
        for name, which in zip(names, shown, strict=True)
    ]
    return {"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "y": 1, "xanchor": "left",
            "yanchor": "top", "showactive": True, "font": {"color": "#1b1f24"}}  # fmt: skip


def _marks(name: str, places: Array, colour: str, symbol: str) -> go.Scatter3d:
    x, y, z = places.T.astype(np.float32)
    marker = {"size": 4, "color": colour, "symbol": symbol}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name=name, hoverinfo="name")


def _segments(part: Segments, colours: Mapping[str, str]) -> go.Scatter3d:
    gaps = np.full_like(part.start, np.nan)
    x, y, z = np.stack([part.start, part.end, gaps], axis=1).reshape(-1, 3).T.astype(np.float32)
    colour = colours[part.estimator] if part.estimator else segment_colour(part.name)
    thin = part.name in ("true normals", "sightline from the camera")
    line = {"color": colour, "width": 2 if thin else 7 if part.estimator else 4}
    return go.Scatter3d(
        x=x, y=y, z=z, mode="lines", line=line, name=escape(part.name), hoverinfo="name",
    )  # fmt: skip
