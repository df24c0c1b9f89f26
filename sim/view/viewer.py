"""A view in the browser with viser: a live page with switches, or one offline file."""

from __future__ import annotations

import contextlib
import html
import io
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from sim.view.returns import CHANGE_RGB, SESSION_RGB
from sim.view.view import ROCK_AFTER, ROCK_BEFORE, Play, View

PAGE_MARK = '<meta name="generator" content="tunnelcd view">'
"""Stands near the start of each page that `tunnelcd view` may replace, as in the template of an answer's page."""

_MISSING = "the viewer needs viser: pip install 'tunnelcd[view]'"
# Of the player: the share of the drives at first, the step, and the pause after a step.
_START, _STEP, _PAUSE_S = 0.5, 0.002, 0.1
_SIDES = {"from inside only": "front", "from both sides": "double"}


def require_viser() -> Any:
    """Return the module viser.

    Raises:
        InputError: It is not installed.
    """
    try:
        import viser  # noqa: PLC0415 - an extra, needed by nothing but the viewer
    except ImportError as error:
        raise InputError(_MISSING) from error
    return viser


@contextlib.contextmanager
def running_server(port: int, host: str = "localhost") -> Iterator[Any]:
    """Run a viser server; port 0 takes any that is free.

    Raises:
        InputError: viser is not installed, or the port is taken.
    """
    viser = require_viser()
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # its banner: only the command line prints
            server = viser.ViserServer(host=host, port=port, verbose=False)
    except (OSError, RuntimeError, OverflowError) as error:
        raise InputError(f"--port {port}: cannot listen there on {host}: {error}") from error
    try:
        if port not in (0, server.get_port()):
            raise InputError(f"--port {port}: taken by another program: name a free one, or end that program")
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def show(server: Any, view: View) -> None:
    """Put a view into a server's scene, with the switches beside it."""
    if view.play is not None:
        surfaces, clouds = view.play(_START)
        known = {surface.name for surface in view.surfaces}
        view = replace(
            view,
            surfaces=(*view.surfaces, *(surface for surface in surfaces if surface.name not in known)),
            clouds=(*view.clouds, *(replace(cloud, is_shown=False) for cloud in clouds)),
        )
    handles = _add_nodes(server, view)
    _add_switches(server, view, handles)
    if view.play is not None:
        _add_player(server.gui, view.play, handles)


def write_html(view: View, file: Path, legend: str = "") -> None:
    """Write a view as one file that needs no server and no network; its scene tree shows and hides every part.

    Args:
        view: The view.
        file: The file to write.
        legend: HTML elements laid over the scene.

    Raises:
        InputError: viser is not installed, or the file cannot be written.
    """
    with running_server(0) as server:
        _add_nodes(server, view)
        text = server.scene.as_html()
    if legend:
        before, end, after = text.rpartition("</body>")
        text = f"{before}{legend}{end}{after}"
    text = text.replace("<head>", f"<head>{PAGE_MARK}", 1)
    text = text.replace("<title>Viser</title>", f"<title>{html.escape(view.title)}</title>", 1)
    try:
        file.parent.stat()  # a new folder is not made
        with whole_file(file) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error.strerror}") from error


def markdown_text(words: str) -> str:
    """Return text as Markdown shows it literally, with HTML or without: a family may be called `<img>`."""
    return "".join(letter if letter.isalnum() or letter == " " else f"&#{ord(letter)};" for letter in visible(words))


def _add_nodes(server: Any, view: View) -> dict[str, Any]:
    """Add every part under its name, and return the handle of each group and of every part by name."""
    scene = server.scene
    server.initial_camera.position = view.eye
    server.initial_camera.look_at = view.target
    handles: dict[str, Any] = {}
    parts = (view.bands, view.surfaces, view.lines, view.clouds, view.labels)
    for name in [part.name for some in parts for part in some]:
        for group in reversed(PurePosixPath(name).parents[:-1]):
            if str(group) not in handles:
                handles[str(group)] = scene.add_frame(f"/{group}", show_axes=False)
    for surface in (*view.bands, *view.surfaces):
        mesh = surface.mesh
        # Walls are one-sided, so that the camera sees through the near wall from outside.
        side = "front" if surface.name.startswith(("walls/", "rock/")) else "double"
        handles[surface.name] = scene.add_mesh_simple(
            f"/{surface.name}",
            mesh.vertices,
            mesh.faces,
            color=surface.rgb,
            flat_shading=True,
            side=side,
            cast_shadow=False,
            receive_shadow=False,
        )
    if ROCK_BEFORE in handles:
        handles[ROCK_BEFORE].visible = False  # it lies in front of rock that fell out
    for line in view.lines:
        pairs = np.stack([line.points[:-1], line.points[1:]], axis=1).astype(np.float32)
        handles[line.name] = scene.add_line_segments(f"/{line.name}", pairs, line.rgb, thickness=0.06)
    for cloud in view.clouds:
        first = next(iter(cloud.colours.values()))
        handles[cloud.name] = scene.add_point_cloud(
            f"/{cloud.name}",
            cloud.points,
            first,
            point_size=cloud.size_m,
            precision="float32",
            point_shading="flat",
            visible=cloud.is_shown and not view.bands,  # points would hide the walls
        )
    for label in view.labels:
        handles[label.name] = scene.add_label(f"/{label.name}", label.text, position=label.position)
    return handles


def _add_switches(server: Any, view: View, handles: dict[str, Any]) -> None:
    gui = server.gui
    gui.configure_theme(show_share_button=False)
    gui.set_panel_label("tunnelcd")
    gui.add_markdown(_legend(view))
    if view.bands:
        _add_wall_switches(gui, view, handles)
    for group in _switched(handles):
        _add_switch(gui, group, handles[group])
    for cloud in view.clouds:
        if not cloud.name.startswith(("changes/", "displacement/")):  # their group has one switch
            _add_switch(gui, cloud.name, handles[cloud.name])
    if view.clouds and len(view.clouds[0].colours) > 1:
        choice = gui.add_dropdown("returns by", tuple(view.clouds[0].colours))

        def recolour(_event: Any) -> None:
            for cloud in view.clouds:
                if cloud.name.startswith("revolution/"):  # it may be another one by now
                    continue
                handles[cloud.name].colors = cloud.colours[choice.value]

        choice.on_update(recolour)


def _add_player(gui: Any, play: Play, handles: dict[str, Any]) -> None:
    """Add a slider for the share of both drives, and a switch that moves it; what is elsewhere then is placed anew."""
    share = gui.add_slider("share of the drives", min=0.0, max=1.0, step=_STEP, initial_value=_START)
    running = gui.add_checkbox("play", initial_value=False)

    def move(_event: Any) -> None:
        surfaces, clouds = play(share.value)
        for surface in surfaces:
            handles[surface.name].vertices = surface.mesh.vertices.astype(np.float32)
        for cloud in clouds:
            handles[cloud.name].points = cloud.points
            handles[cloud.name].colors = next(iter(cloud.colours.values()))

    turn = threading.Lock()

    def run() -> None:
        with turn:  # one at a time, however often the switch is turned
            while running.value:
                share.value = 0.0 if share.value >= 1.0 else min(share.value + _STEP, 1.0)
                time.sleep(_PAUSE_S)

    share.on_update(move)
    running.on_update(lambda _event: threading.Thread(target=run, daemon=True).start())


def _add_wall_switches(gui: Any, view: View, handles: dict[str, Any]) -> None:
    bands = [(band.from_m, handles[band.name]) for band in view.bands]
    step_m = round(bands[1][0] - bands[0][0], 1) if len(bands) > 1 else 1.0
    top_m = round(bands[-1][0] + step_m, 1)
    cut = gui.add_slider("walls up to, m above floor", min=0.0, max=top_m, step=step_m, initial_value=top_m)
    sides = gui.add_dropdown("walls seen", tuple(_SIDES))

    def cut_off(_event: Any) -> None:
        for from_m, handle in bands:
            handle.visible = from_m < cut.value - 1e-6

    def turn(_event: Any) -> None:
        for _, handle in bands:
            handle.side = _SIDES[sides.value]

    cut.on_update(cut_off)
    sides.on_update(turn)


def _add_switch(gui: Any, group: str, handle: Any) -> None:
    box = gui.add_checkbox(group, initial_value=handle.visible)

    def switch(_event: Any) -> None:
        handle.visible = box.value

    box.on_update(switch)


def _switched(handles: dict[str, Any]) -> list[str]:
    """Return the groups with a switch: the outermost, and of those that have sessions or kinds the level below."""
    inner = [name for name in handles if name.count("/") == 1]
    split = ("fixtures", "changes", "movers", "rock", "paths", "returns", "revolution")
    groups = [name for name in handles if "/" not in name and name not in split]
    kinds = sorted(name for name in inner if name.startswith(("fixtures/", "changes/", "movers/", "rock/")))
    return [*groups, *kinds, *(name for name in inner if name.startswith("paths/"))]


def _legend(view: View) -> str:
    swatch = '<span style="color:rgb{}">■</span> {}'
    kinds = [kind for kind in CHANGE_RGB if any(part.name.startswith(f"changes/{kind}/") for part in view.surfaces)]
    sessions = [name for name in SESSION_RGB if any(line.name == f"paths/{name}" for line in view.lines)]
    colours = [(CHANGE_RGB[kind], kind) for kind in kinds] + [(SESSION_RGB[name], f"path {name}") for name in sessions]
    named = view.legend or colours
    head = f"**{markdown_text(view.title)}**", " ".join(swatch.format(rgb, name) for rgb, name in named)
    rock = [part for part in view.surfaces if part.name.startswith(f"{ROCK_AFTER}/")]
    told = " ".join(swatch.format(part.rgb, PurePosixPath(part.name).name) for part in rock)
    moved = f"rock moved, + into the void: {told}" if rock else ""
    lines = [*head, moved, *map(markdown_text, view.notes)]
    return "\n\n".join(line for line in lines if line)
