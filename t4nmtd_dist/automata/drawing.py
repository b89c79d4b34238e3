"""Draws an automaton as SVG, with transitions coloured by group, such as sub-tasks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from html import escape

import numpy as np

from t4nmtd_dist.automata.cubes import Cube, Guard, guard_text
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.layout import RADIUS, Box, Curve, Points, free_directions, label_boxes, place, route
from t4nmtd_dist.automata.reduction import Transition

BACKGROUND, INK, FAINT, CASING = "#faf9f5", "#22252a", "#8d9299", "#4a4e55"
PALETTE = (
    "#1f6fb4", "#d9730d", "#2b8a3e", "#c2255c", "#7048b6", "#0b8a8a", "#8a5a2b", "#b59a00", "#e0529c",
)  # fmt: skip
NAMED = {
    "red": "#d62828", "blue": "#1f6fb4", "green": "#2b8a3e", "pink": "#ee7fb0", "black": "#111111",
    "white": "#ffffff", "grey": "#9aa0a6", "gray": "#9aa0a6", "yellow": "#f0c000", "orange": "#e8710a",
    "purple": "#7048b6", "brown": "#8a5a2b",
}  # fmt: skip
LABEL_LENGTH = 17
CHARACTER = 6.1
MARGIN = 70.0


Groups = Mapping[str, Collection[Transition]]


def draw_svg(dfa: DFA, groups: Groups, colours: Mapping[str, str] | None = None) -> str:
    """Draw a task automaton.

    A transition in several groups is striped in their colours; one in none is grey and dashed. Transitions into error
    states are stubs that end in a cross. Hovering shows the full guard.

    Args:
        dfa: the task automaton.
        groups: transitions by group name, such as sub-tasks.
        colours: an SVG colour per group; None for ``group_colours``.

    Returns:
        An SVG document with a background, readable on light and dark pages.
    """
    drawn = [tau for tau in dfa.edges if tau[0] != tau[1] and not dfa.error & set(tau)]
    body = [q for q in range(dfa.states) if q not in dfa.error]
    grouped = sorted({tau for taus in groups.values() for tau in taus})
    position = place(dfa.initial, grouped or drawn, body)
    curves = route(drawn, position)
    colours = group_colours(groups) if colours is None else colours
    parts = [
        *_transitions(dfa, groups, curves, colours),
        *(_loop_and_stub(dfa, q, position[q], curves.values()) for q in body),
        *(_state(dfa, q, position[q]) for q in body),
        *_labels(dfa, curves, position),
    ]
    return _document(parts, _extent(curves, position), _legend(dfa, groups, colours))


def group_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour per name: the named colour if the name is one, else the next from ``PALETTE``."""
    names = list(names)
    free = [colour for colour in PALETTE if colour not in {NAMED.get(name) for name in names}]
    others = [name for name in names if name not in NAMED]
    return {name: NAMED[name] if name in NAMED else free[others.index(name) % len(free)] for name in names}


def _transitions(dfa: DFA, groups: Groups, curves: dict[Transition, Curve], colours: Mapping[str, str]) -> list[str]:
    owners = {tau: [name for name, taus in groups.items() if tau in taus] for tau in curves}
    order = sorted(curves, key=lambda tau: bool(owners[tau]))
    return [_transition(dfa, tau, curves[tau], [colours[name] for name in owners[tau]]) for tau in order]


def _transition(dfa: DFA, tau: Transition, curve: Curve, colours: list[str]) -> str:
    """One curve: casing, one dashed stroke per colour, and arrow head."""
    path = "M{:.1f} {:.1f} Q{:.1f} {:.1f} {:.1f} {:.1f}".format(*curve.start, *curve.control, *curve.end)
    if not colours:
        strokes = f'<path d="{path}" stroke="{FAINT}" stroke-width="1.2" stroke-dasharray="4 4"/>'
    else:
        dash = f' stroke-dasharray="9 {9 * (len(colours) - 1)}"' if len(colours) > 1 else ""
        strokes = f'<path d="{path}" stroke="{CASING}" stroke-width="3.6"/>' + "".join(
            f'<path d="{path}" stroke="{colour}" stroke-width="2.4"{dash} stroke-dashoffset="{-9 * i}"/>'
            for i, colour in enumerate(colours)
        )
    head = _arrow_head(curve.end, curve.end - curve.at(0.9), colours[0] if colours else FAINT)
    return f'<g fill="none">{_title(dfa, tau)}{strokes}{head}</g>'


def _arrow_head(tip: Points, along: Points, colour: str, size: float = 1.0) -> str:
    forward = size * along / np.hypot(*along)
    side = np.array([-forward[1], forward[0]])
    corners = (tip + 3 * forward, tip - 8 * forward + 5 * side, tip - 8 * forward - 5 * side)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    return f'<polygon points="{points}" fill="{colour}" stroke="{CASING}" stroke-width="0.8"/>'


def _loop_and_stub(dfa: DFA, q: int, at: Points, curves: Iterable[Curve]) -> str:
    """A state's self-loop and error transitions, where there is room."""
    up, *rest = free_directions(at, curves)
    errors = [tau for tau in dfa.edges if tau[0] == q and tau[1] in dfa.error]
    loop = _self_loop(dfa, q, at, up) if (q, q) in dfa.edges else ""
    return loop + "".join(_stub(dfa, tau, at, way) for tau, way in zip(errors, rest, strict=False))


def _self_loop(dfa: DFA, q: int, at: Points, out: Points) -> str:
    side = np.array([-out[1], out[0]])
    start, end = at + RADIUS * out - 8 * side, at + RADIUS * out + 8 * side
    first, second = at + 54 * out - 20 * side, at + 54 * out + 20 * side
    path = "M{:.1f} {:.1f} C{:.1f} {:.1f} {:.1f} {:.1f} {:.1f} {:.1f}".format(*start, *first, *second, *end)
    loop = f'<path d="{path}" stroke="{FAINT}" stroke-width="1.2"/>'
    head = _arrow_head(end + 2 * out, 0.35 * side - out, FAINT, size=0.75)
    x, y = at + 51 * out + np.array([0.0, 3.0 + 4 * out[1]])
    anchor = "middle" if abs(out[0]) < 0.1 else "start" if out[0] > 0 else "end"
    text = _text(x, y, _short(dfa.edges[q, q]), size=9.5, colour=FAINT, anchor=anchor)
    return f'<g fill="none">{_title(dfa, (q, q))}{loop}{head}</g>{text}'


def _stub(dfa: DFA, tau: Transition, at: Points, out: Points) -> str:
    """A transition into an error state: a short arrow ending in a cross."""
    (x, y), (to_x, to_y) = at + RADIUS * out, at + (RADIUS + 15) * out
    lines = f"M{x:.1f} {y:.1f} L{to_x:.1f} {to_y:.1f} m-4 -4 l8 8 m0 -8 l-8 8"
    path = f'<path d="{lines}" stroke="{FAINT}" stroke-width="1.4" fill="none"/>'
    return f"<g>{_title(dfa, tau)}{path}</g>"


def _state(dfa: DFA, q: int, at: Points) -> str:
    x, y = at
    circle = '<circle cx="{:.1f}" cy="{:.1f}" r="{:.1f}" fill="{}" stroke="{}" stroke-width="1.6"/>'
    parts = [circle.format(x, y, RADIUS, "#ffffff", INK)]
    if q in dfa.accepting:
        parts.append(circle.format(x, y, RADIUS - 4.5, "#e6f3e8", INK))
    if q == dfa.initial:
        parts.append(f'<path d="M{x - RADIUS - 34:.1f} {y:.1f} h28" stroke="{INK}" stroke-width="1.6"/>')
        parts.append(_arrow_head(np.array([x - RADIUS - 4, y]), np.array([1.0, 0.0]), INK))
    return "".join(parts) + _text(x, y + 4.5, str(q), size=13, weight="600")


def _labels(dfa: DFA, curves: dict[Transition, Curve], position: dict[int, Points]) -> list[str]:
    texts = {tau: _short(dfa.edges[tau]) for tau in curves}
    taken = [Box(float(x), float(y), RADIUS + 3, RADIUS + 3) for x, y in position.values()]
    taken += [_loop_box(position[q], curves) for q in position if (q, q) in dfa.edges]
    boxes = label_boxes(curves, {tau: len(text) * CHARACTER + 6 for tau, text in texts.items()}, taken)
    return [
        f'<g>{_title(dfa, tau)}<rect x="{box.x - box.half_width:.1f}" y="{box.y - box.half_height:.1f}" '
        f'width="{2 * box.half_width:.1f}" height="{2 * box.half_height:.1f}" rx="4" fill="{BACKGROUND}" '
        f'fill-opacity="0.97"/>{_text(box.x, box.y + 3.8, texts[tau], size=11)}</g>'
        for tau, box in boxes.items()
    ]


def _loop_box(at: Points, curves: dict[Transition, Curve]) -> Box:
    x, y = at + 46 * free_directions(at, curves.values())[0]
    return Box(float(x), float(y), 42, 12)


def _short(guard: Guard) -> str:
    """A guard shortened for a label, positive literals first."""
    text = " | ".join(map(_short_cube, guard))
    return text if len(text) <= LABEL_LENGTH else text[: LABEL_LENGTH - 1].rstrip(" |¬") + "…"


def _short_cube(cube: Cube) -> str:
    ordered = sorted(cube, key=lambda literal: literal.startswith("~"))
    return " ".join(ordered).replace("~", "¬") or "true"


def _title(dfa: DFA, tau: Transition) -> str:
    return f"<title>{tau[0]} → {tau[1]}: {escape(guard_text(dfa.edges[tau]))}</title>"


def _text(
    x: float,
    y: float,
    text: str,
    *,
    size: float,
    colour: str = INK,
    weight: str = "400",
    anchor: str = "middle",
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" fill="{colour}" '
        f'text-anchor="{anchor}">{escape(text)}</text>'
    )


def _extent(curves: dict[Transition, Curve], position: dict[int, Points]) -> tuple[Points, Points]:
    """Upper left and lower right corner of the drawing."""
    points = np.concatenate(
        [np.array(list(position.values())), *(curve.at(np.linspace(0, 1, 9)) for curve in curves.values())]
    )
    return points.min(axis=0) - MARGIN - (45, 0), points.max(axis=0) + MARGIN


def _legend(dfa: DFA, groups: Groups, colours: Mapping[str, str]) -> list[tuple[str, str]]:
    """(swatch, text) of every entry; swatches are 26 pixels wide, around (13, 0)."""
    swatch = '<path d="M0 0 h26" stroke="{}" stroke-width="{}"/>'
    entries = [
        (swatch.format(CASING, 4.6) + swatch.format(colours[name], 3.2), f"{name} ({len(taus)})")
        for name, taus in groups.items()
    ]
    entries.append((f'<path d="M0 0 h26" stroke="{FAINT}" stroke-dasharray="4 4"/>', "in no sub-task"))
    if dfa.error:
        names = ", ".join(map(str, sorted(dfa.error)))
        cross = f'<path d="M9 -4 l8 8 m0 -8 l-8 8" stroke="{FAINT}" stroke-width="1.4"/>'
        entries.append((cross, f"into error state {names}"))
    return entries


def _document(parts: Iterable[str], extent: tuple[Points, Points], legend: list[tuple[str, str]]) -> str:
    (left, top), (right, bottom) = extent
    width = max(float(right - left), 420.0)
    rows, x, y = [], 24.0, float(bottom - top) + 6
    for swatch, text in legend:
        entry = 26 + 8 + len(text) * 6.6 + 22
        if x + entry > width and x > 24:
            x, y = 24.0, y + 24
        label = _text(34, 4, text, size=12, anchor="start")
        rows.append(f'<g transform="translate({x:.1f} {y:.1f})">{swatch}{label}</g>')
        x += entry
    height = y + 26
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="Helvetica, Arial, DejaVu Sans, sans-serif">'
        f'<rect width="100%" height="100%" rx="10" fill="{BACKGROUND}" stroke="#d9d7cf"/>'
        f'<g transform="translate({-left:.1f} {-top:.1f})">{"".join(parts)}</g>{"".join(rows)}</svg>\n'
    )
