"""Maps of a campaign drawn: every quantity over two axes, or slices through a volume of three."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from undertow.base import InvalidInputError
from undertow.closed_loop.figures import COLOURS, figure_bytes, label_of, style
from undertow.models import FloatArray
from undertow.proofs.claims.certificate import read_certificate
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.claims.verify import match
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.claims import SurfaceRegion
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.studies.campaign.region_map import EVENTS, RegionMap
from undertow.studies.campaign.run import Campaign
from undertow.studies.campaign.store import loaded

#: Most points of an axis that are drawn; a finer grid is thinned out.
DRAWN = 600

#: Slices through a volume.
SLICES = 6

#: How states that do not come home are shown, by event.
LOST = {
    "singular": ("#c9c9c9", "the law ends, (37)"),
    "constraint": ("#e3d4ea", "beyond the travel"),
    "diverged": ("#f5d9c8", "falls"),
    "horizon": ("#fff3c4", "not within the horizon"),
}

#: What a certificate proves of a map's states: of those on the surface, or of any.
Proved = LyapunovFunction | TerminalEllipsoid


def picture(campaign: Campaign, proved: Proved | None = None) -> Figure:
    """Return the maps of a campaign's store; white is what is not computed yet.

    ``campaign``: over two axes, or a region over three. ``proved``: a proved set of the sliding
    motion, drawn into a region of states on its surface; or a proved terminal set, which is too
    small for a map and is drawn larger, beside its place. Raises InvalidInputError for other
    numbers of axes, a set of the sliding motion where the states are not on a surface, and a
    terminal set where those that stay as they are are not at the target.
    """
    study: Any = campaign.study
    data = loaded(campaign.path, campaign.dataset().isel({
        axis.name: slice(None, None, -(-len(axis.values) // DRAWN)) for axis in study.axes
    }))  # fmt: skip
    region = isinstance(study, RegionMap)
    if not (len(study.axes) == 2 or (region and len(study.axes) == 3)):
        raise InvalidInputError(
            "axes of a picture", value=len(study.axes), limit="two, or three states of a region"
        )
    if isinstance(proved, LyapunovFunction) and not (region and study.sliding):
        raise InvalidInputError(
            "proved set in a picture", value="states off the surface", limit="sliding = true"
        )
    if isinstance(proved, TerminalEllipsoid) and (not region or np.any(study.at)):
        raise InvalidInputError(
            "proved terminal set in a picture", value="states off the target",
            limit="a region, other states at the target", remedy="Leave the table 'at' out",
        )  # fmt: skip
    if region and len(study.axes) == 3:
        return _volume(study, data)
    names = [name for name in study.variables if name != "event"]
    with style():
        figure = Figure(figsize=(4.3 * len(names) + 0.4, 4.3), layout="constrained")
        for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
            mesh = _map(axes, study, data, name)
            facts = data[name].attrs
            unit = "" if facts["units"] == "1" else f" ({facts['units']})"
            figure.colorbar(mesh, ax=axes, label=f"{name}{unit}", extend="max")
            if isinstance(proved, TerminalEllipsoid):
                _draw_terminal(axes, study, proved)
            elif proved is not None:
                _draw_proved(axes, study, proved)
        _legend(figure, study, data, proved)
        figure.suptitle(_title(study, data), fontsize=10)
    return figure


def picture_file(campaign: Campaign, proof: Path | None = None) -> tuple[bytes, list[str]]:
    """Return :func:`picture` as PNG, and what is to be said of the region of a certificate.

    Raises InvalidInputError, ArtefactError or CertificateError as for :func:`picture` and
    :func:`proved_set`.
    """
    if proof is None:
        return figure_bytes(picture(campaign)), []
    if not isinstance(campaign.study, RegionMap):
        raise InvalidInputError(
            "certificate of a picture", value=campaign.study.kind, limit="a region"
        )
    proved = proved_set(campaign.study, proof)
    return figure_bytes(picture(campaign, proved)), [proved_words(campaign, proved)]


def _map(axes: Axes, study: Any, data: Any, name: str, most: float | None = None) -> Any:
    """Draw one quantity over the two axes of the data, and why the rest did not come home."""
    (fa, la), (fb, lb) = (_label(study, axis) for axis in data[name].dims)
    a, b = (np.asarray(data[axis]) for axis in data[name].dims)
    values = np.asarray(data[name]).T
    if "event" in data:
        events = np.asarray(data.event).T
        for event, (colour, _) in LOST.items():
            which = np.where(events == EVENTS.index(event), 1.0, np.nan)
            axes.pcolormesh(fa * a, fb * b, which, cmap=ListedColormap([colour]), rasterized=True)
    if most is None:
        most = _most(values)
    mesh = axes.pcolormesh(
        fa * a, fb * b, values, cmap="viridis_r", vmin=0.0, vmax=most, rasterized=True
    )
    axes.set_xlabel(la)
    axes.set_ylabel(lb)
    axes.grid(visible=False)
    return mesh


def _volume(study: Any, data: Any) -> Figure:
    """Draw the time to come home in slices through a volume."""
    last = study.axes[-1]
    values = np.asarray(data[last.name])
    places = np.unique(np.linspace(0, len(values) - 1, SLICES).round().astype(int))
    most = _most(np.asarray(data.time))
    with style():
        figure = Figure(figsize=(9.6, 6.2), layout="constrained")
        panels = figure.subplots(2, -(-len(places) // 2), sharex=True, sharey=True, squeeze=False)
        mesh: Any = None
        for axes, place in zip(panels.ravel(), places, strict=False):
            mesh = _map(axes, study, data.isel({last.name: int(place)}), "time", most)
            axes.set_title(_said(study, last.name, values[place]), loc="left")
            axes.label_outer()
        figure.colorbar(mesh, ax=panels, label="time (s)", extend="max")
        _legend(figure, study, data, None)
        figure.suptitle(_title(study, data), fontsize=10)
    return figure


def _legend(figure: Figure, study: Any, data: Any, proved: Proved | None) -> None:
    handles: list[Any] = []
    if "event" in data:
        events = np.unique(np.asarray(data.event))
        for event, (colour, words) in LOST.items():
            if EVENTS.index(event) in events:
                handles.append(Patch(color=colour, label=words))
    if proved is not None:
        line = Line2D([], [], color=COLOURS["vermilion"], lw=1.6)
        line.set_label(
            "proved terminal set, inputs limited, drawn larger"
            if isinstance(proved, TerminalEllipsoid)
            else "proved region of the sliding motion, inputs not limited"
        )
        handles.append(line)
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4)


def _draw_proved(axes: Axes, study: RegionMap, proved: LyapunovFunction) -> None:
    """Draw the edge of {V ≤ 1} in the slice."""
    (fa, _), (fb, _) = (_label(study, axis.name) for axis in study.axes)
    a, b = (np.linspace(axis.values[0], axis.values[-1], 400) for axis in study.axes)
    points = np.tile(study.at, (len(a), len(b), 1))
    points[..., study.places[0]], points[..., study.places[1]] = np.meshgrid(a, b, indexing="ij")
    with np.errstate(all="ignore"):
        level = proved(study.surface.sliding_coordinates(points))
    axes.contour(
        fa * a, fb * b, np.where(np.isfinite(level), level, 2.0).T, [1.0],
        colors=[to_rgba(COLOURS["vermilion"])], linewidths=1.6,
    )  # fmt: skip


def _draw_terminal(axes: Axes, study: RegionMap, proved: TerminalEllipsoid) -> None:
    """Draw the edge of a terminal set in the slice, in a frame of its own, and where it is."""
    colour = COLOURS["vermilion"]
    factors = np.array([_label(study, axis.name)[0] for axis in study.axes])
    edge = (factors * _cut(study, proved)).T
    axes.plot(0.0, 0.0, "+", color=colour, ms=9, mew=1.4)
    frame = axes.inset_axes((0.73, 0.68, 0.25, 0.3))
    frame.plot(*edge, color=colour, lw=1.6)
    for axis, reach in zip((frame.xaxis, frame.yaxis), edge.max(axis=1), strict=True):
        axis.set_ticks([-reach, reach], [f"−{reach:.2g}", f"{reach:.2g}"], fontsize=6)
    frame.tick_params(length=2, pad=1)


def _cut(study: RegionMap, proved: TerminalEllipsoid) -> FloatArray:
    """Return points on the edge of a terminal set in the slice through the target, (K, 2)."""
    round_once = np.linspace(0.0, 2 * np.pi, 181)
    R = np.linalg.qr(proved.W[:, study.places], mode="r")  # |W x| = |R p| in the slice
    circle = proved.radius * np.array([np.cos(round_once), np.sin(round_once)])
    return np.asarray(np.linalg.solve(R, circle).T)


def proved_set(study: RegionMap, path: Path) -> Proved:
    """Return what a certificate states of the study's mechanism and law.

    For states on the surface that is a region on it, else a terminal set.  It is not decided again
    here: ``undertow verify`` does. Raises InvalidInputError when it states none of this surface, or
    of this law; ArtefactError or CertificateError when it cannot be read, or is about another
    mechanism.
    """
    certificate = read_certificate(path)
    wanted = study.surface.vector
    if not study.sliding:
        wanted = np.append(wanted, study.loop.reaching.vector(study.mechanism.m))
    match(certificate, study.mechanism, own_parameters=True)
    for subject in certificate.subjects:
        law = np.append(subject.surface.vector, subject.reaching.vector(study.mechanism.m))
        if not np.array_equal(law[: len(wanted)], wanted):
            continue
        for claim in (stated.claim for stated in subject.claims):
            if isinstance(claim, kernel.SurfaceRegion) and study.sliding:
                return _function(claim)
            if isinstance(claim, kernel.TerminalEllipsoid) and not study.sliding:
                return TerminalEllipsoid.of(claim)
    raise InvalidInputError(
        f"certificate '{path}' for a picture",
        value="no region on this surface" if study.sliding else "no terminal set of this law",
        limit=f"one on {study.surface}",
        remedy="Give the definition the certificate's surface",
    )


def proved_words(campaign: Campaign, proved: Proved) -> str:
    """Say how many states of a finished shard in the proved set come home with the input limits.

    Of a terminal set, in which there are hardly any, how far it reaches in the slice.
    """
    study, data = campaign.study, campaign.dataset()
    assert isinstance(study, RegionMap)
    if isinstance(proved, TerminalEllipsoid):
        R = np.linalg.qr(proved.W[:, study.places], mode="r")  # |W x| = |R p| in the slice
        sizes = proved.radius * np.linalg.norm(np.linalg.inv(R), axis=1)
        reach = (_said(study, a.name, v, "±") for a, v in zip(study.axes, sizes, strict=True))
        return f"proved terminal set, inputs limited: {', '.join(reach)}"
    inside = home = 0
    for shard in range(study.shards):
        _, states = study.states(shard)
        events = np.asarray(data.event[study.part(shard)]).ravel()
        with np.errstate(all="ignore"):
            within = (proved(study.surface.sliding_coordinates(states)) <= 1.0) & (events >= 0)
        inside += int(within.sum())
        home += int((events[within] == EVENTS.index("reached")).sum())
    return f"{inside} states in the proved region; {home} of them come home with the input limits"


def _function(claim: SurfaceRegion) -> LyapunovFunction:
    """Return the last, widest function of a claim in floats."""
    function, stretch = claim.functions[-1], claim.stretch
    return LyapunovFunction(
        np.linalg.inv(np.array(function.A, dtype=float)),
        np.array(function.exponents),
        np.array(function.coefficients, dtype=float),
        np.array(stretch.S, dtype=float) if stretch.S else None,
        float(stretch.L) if stretch.L else np.inf,
    )


def _most(values: FloatArray) -> float:
    """Return the end of the colours: what all but one per cent are below."""
    good = values[np.isfinite(values)]
    return float(np.percentile(good, 99)) if len(good) else 1.0


def _label(study: Any, name: str) -> tuple[float, str]:
    """Return the factor to display units, and the label of an axis."""
    names = study.mechanism.state_names
    if name not in names:
        axis = next(axis for axis in study.axes if axis.name == name)
        return 1.0, f"{name} ({axis.unit})"
    index, n = names.index(name), study.mechanism.n
    return label_of(study.mechanism.coordinates[index % n], index >= n)


def _said(study: Any, name: str, value: float, relation: str = "=") -> str:
    """Return the value of an axis in display units, in words."""
    factor, label = _label(study, name)
    symbol, _, unit = label.partition(" (")
    space = "" if unit.startswith("°") else " "
    return f"{symbol} {relation} {factor * value:.3g}{space}{unit[:-1]}"


def _title(study: Any, data: Any) -> str:
    title = f"{study.mechanism.name.replace('_', ' ')}: {data.attrs['title'].partition(' ')[0]}"
    if not isinstance(study, RegionMap):
        return title
    limits = ", ".join(f"|{i.name}| ≤ {i.limit:g} {i.unit}" for i in study.mechanism.inputs)
    events = np.asarray(data.event)
    home = 100 * (events == EVENTS.index("reached")).sum() / max((events >= 0).sum(), 1)
    where = ", started on the surface s = 0" if study.sliding else ""
    part = "slice" if len(study.axes) == 2 else "volume"
    return f"{title} from which motions come home{where}; {limits}; {home:.1f} % of the {part}"
