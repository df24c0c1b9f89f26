"""The truth of a simulated pair, stored apart from the sessions so that they can be handed out without it.

    PAIR/truth/changes.json          the changes, the movers, the scenario as drawn, family, seed
    PAIR/before/truth/poses.npz      world_T_sensor (S, 4, 4) float64, at the middle column of each revolution
    PAIR/before/truth/00000.npz      per chunk: instance (s, R, W) int16, change (s, R, W) int16, R as in the session
    PAIR/before/truth/movers.npz     only with movers: see `MoverTrack`
    PAIR/before/truth/surface/00000.npz  per chunk, only where rock changes: displacement (s, R, W) float32, metres,
                                     surface_change (s, R, W) int16
    PAIR/after/truth/...             likewise

`instance`: -1 no return, -2 a false return where nothing stands, -3 a return from mist or dust, -4 what a puddle or a
pane mirrors, -5 glare of a retroreflector, 0 walls, floor and fixtures, n the n-th prop (1-based), n_props + k the k-th
mover of the scenario (1-based).
`change`: 0 (always for an instance below 0 and for a mover), the id of the change that the return belongs to, or -1 for
a mixed return. For a change of group "partial" (moved by less than its own length, or reshaped) only returns farther
than 0.1 m from the other session's true surface belong to it.

`displacement`: how far the walls moved from before to after, positive into the void. Of a return at the true place p it
is the distance to the closest place on the walls of the other session, with the sign of the side on which p lies. NaN
for returns that are not of the walls or mixed, where nothing is within 5 m, and, beside a surface change, for a return
that came from beside the middle of its beam.
`surface_change`: id of the surface change to which the place of the return belongs, 0 for none.

With several rays per beam a return may blend surfaces. `instance` is then that of the strongest ray. A return belongs
to a changed prop of its session, or to all the rest, if at least 90 % of its light came from there. A return below that
for every one of them is mixed: its `change` is -1, and it counts for nothing. Sessions simulated before metrics version
6 hold no -1; there `change` is 0 for returns more than 0.1 m off the surface of `instance`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_json, read_npz
from cdpipe.core.geometry import FARTHEST_M, Float32Array, Float64Array, Int32Array

Int16Array = npt.NDArray[np.int16]
SessionName = Literal["before", "after"]
SESSIONS: tuple[SessionName, ...] = ("before", "after")
Kind = Literal["added", "removed", "moved", "reshaped"]
Group = Literal["full", "partial"]
SurfaceKind = Literal["convergence", "heave", "shotcrete", "scar", "rubble", "fill", "face"]
_Four = Field(min_length=4, max_length=4)
_CHECKS = ConfigDict(extra="forbid", allow_inf_nan=False)
MIXED = -1  # `change` of a return that belongs neither to a change nor to the rest
_LABELS = {"instance": ArraySpec("s,H,W", "int16"), "change": ArraySpec("s,H,W", "int16")}
_SURFACE = {
    "displacement": ArraySpec("s,H,W", "float32", is_finite=False),
    "surface_change": ArraySpec("s,H,W", "int16"),
}
_POSES = {"world_T_sensor": ArraySpec("S,4,4", "float64")}
_TRACK = {
    "world_T_mover": ArraySpec("M,S,4,4", "float64"),
    "n_returns": ArraySpec("M,S", "int32"),
    "seen_world": ArraySpec("M,S,3", "float64", is_finite=False),
}


@dataclass(frozen=True, slots=True)
class Change:
    """One object added to or removed from the tunnel between the sessions.

    Attributes:
        id: 1-based, unique in the pair.
        name: The prop's name.
        prop_kind: What it is, e.g. "chair".
        kind: added, removed, moved (one half of a move) or reshaped.
        session: The session that holds its returns.
        partner: Id of the other half of a move, or None.
        group: "full", or "partial" for short moves and reshaped props.
        instance: Value of its returns in `instance`.
        world_T_object: (4, 4) pose as nested lists.
        hull_volume_m3: Volume of its convex hull; of a reshaped prop that of the removed part.
        n_returns: Number of returns with its id in `change`.
        n_cells: Cells of 0.1 m (that session's odom frame) they fill.
        n_ghost_rays: Rays of the other session that would meet it if it stood there.
        is_observable: At least 10 cells and 10 ghost rays.
        why_not: The rule that failed, or "".
        mesh_volume_m3: Volume of a closed surface, None for props of several parts; of a reshaped prop the volume that
            was removed.
        n_returns_other: Returns of the other session with the same `instance`, where the prop stands in both (moved,
            reshaped).
        n_cells_other: Cells of 0.1 m that these fill, in that session's odom frame.
    """

    __pydantic_config__ = _CHECKS
    id: Annotated[int, Field(ge=1, le=32767)]
    name: str
    prop_kind: str
    kind: Kind
    session: SessionName
    partner: int | None
    group: Group
    instance: int
    world_T_object: Annotated[list[Annotated[list[float], _Four]], _Four]
    hull_volume_m3: float
    n_returns: int
    n_cells: int
    n_ghost_rays: int
    is_observable: bool
    why_not: str
    mesh_volume_m3: float | None = None
    n_returns_other: int = 0
    n_cells_other: int = 0


@dataclass(frozen=True, slots=True)
class SurfaceChangeTruth:
    """Rock that moved, came or went between the sessions.

    Signs are positive into the void. Area, largest and mean are those of the before surface, by the distance to the
    closest place of the after surface.

    Attributes:
        id: 1-based, unique among the surface changes of the pair.
        name: The name in the scenario; a scar and its rubble share it.
        kind: What it is.
        partner: Id of the rubble of a scar, of the scar of rubble, else None.
        area_m2: Area of the before surface that moved more than 1 mm.
        volume_m3: Volume of the space between the two surfaces.
        largest_m: Displacement of largest magnitude.
        mean_m: Displacement averaged over that area.
        centre_world: [x, y, z] middle of the before surface that changed.
    """

    __pydantic_config__ = _CHECKS
    id: Annotated[int, Field(ge=1, le=32767)]
    name: str
    kind: SurfaceKind
    partner: int | None
    area_m2: float
    volume_m3: float
    largest_m: float
    mean_m: float
    centre_world: Annotated[list[float], Field(min_length=3, max_length=3)]


@dataclass(frozen=True, slots=True)
class MoverTruth:
    """Something that moved during one session. It is no change.

    Attributes:
        name: The mover's name.
        kind: What it is, e.g. "person".
        instance: Value of its returns in `instance`; the same in both sessions.
        session: The session; a mover of both has one entry for each.
        stretch_m: Length of the line that it goes to and fro on, 0 for one that stays.
        moving_share: Share of the session's revolutions in which it is on its way.
        n_returns: Number of returns with its instance.
    """

    __pydantic_config__ = _CHECKS
    name: str
    kind: str
    instance: int
    session: SessionName
    stretch_m: float
    moving_share: float
    n_returns: int


@dataclass(frozen=True, slots=True, eq=False)
class MoverTrack:
    """Where the M movers of a session were, at the middle column of each of its S revolutions.

    Movers are in the order of their entries in `PairTruth.movers`.

    Attributes:
        world_T_mover: (M, S, 4, 4) pose of each mover's root, on the floor below it; of a curtain its upper edge.
        n_returns: (M, S) int32 number of its returns.
        seen_world: (M, S, 3) mean of their true positions, NaN where there are none.
    """

    world_T_mover: Float64Array
    n_returns: Int32Array
    seen_world: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class PairTruth:
    """Everything known about a pair, beside the per-return labels.

    Attributes:
        family: Scenario family.
        seed: The seed it was drawn with.
        score_radius_m: The family's distance within which a region finds a change.
        changes: All changes, observable or not.
        scenario: The scenario as drawn.
        files: SHA-256 of every file that the scenario names, by its path as seen from the working folder.
        movers: What moved in either session, before first; the file has the key only where there are some.
        surface_changes: Rock that moved, came or went; the file has the key only where there are some.
        story: The story (`sim.story`) of which the pair is two sessions; the file has the key only there.
        graft: What was cast into which recording (`sim.graft`); the file has the key only there.
    """

    __pydantic_config__ = _CHECKS
    family: str
    seed: int
    score_radius_m: float
    changes: tuple[Change, ...]
    scenario: dict[str, Any]
    files: dict[str, str] = field(default_factory=dict)
    movers: tuple[MoverTruth, ...] = ()
    surface_changes: tuple[SurfaceChangeTruth, ...] = ()
    story: dict[str, Any] | None = None
    graft: dict[str, Any] | None = None


def write_pair_truth(pair: Path, truth: PairTruth) -> None:
    """Write `PAIR/truth/changes.json`."""
    (pair / "truth").mkdir(parents=True, exist_ok=True)
    document = asdict(truth)
    for key in ("movers", "surface_changes", "story", "graft"):
        if not document[key]:
            del document[key]  # the truth of an older scenario keeps its bytes
    (pair / "truth" / "changes.json").write_text(json.dumps(document, indent=1))


def read_pair_truth(pair: str | Path) -> PairTruth:
    """Read `PAIR/truth/changes.json`.

    Raises:
        InputError: The pair has no truth, or it is damaged.
    """
    path = Path(pair) / "truth" / "changes.json"
    document = read_json(path, "only simulated pairs have truth to score against", is_finite=True)
    try:
        truth = _reader().validate_python(document)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}: damaged: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    for index, change in enumerate(truth.changes):
        if any(abs(value) > FARTHEST_M for row in change.world_T_object for value in row):
            raise InputError(f"{path}: damaged: changes.{index}: farther than {FARTHEST_M:g} m from the origin")
    for index, rock in enumerate(truth.surface_changes):
        if any(abs(value) > FARTHEST_M for value in rock.centre_world):
            raise InputError(f"{path}: damaged: surface_changes.{index}: farther than {FARTHEST_M:g} m from the origin")
    _require_halves(path, truth)
    return truth


def _require_halves(path: Path, truth: PairTruth) -> None:
    """Refuse ids that stand twice, and halves of a move that do not name each other."""
    for name, entries in (("changes", truth.changes), ("surface_changes", truth.surface_changes)):
        most = Counter(each.id for each in entries).most_common(1)
        if most and most[0][1] > 1:
            raise InputError(f"{path}: damaged: {name}: id {most[0][0]} stands there {most[0][1]} times")
    by_id = {change.id: change for change in truth.changes}
    for change in truth.changes:
        other = by_id.get(change.partner) if change.kind == "moved" and change.partner is not None else None
        if other is not None and (other.partner != change.id or other.session == change.session):
            raise InputError(f"{path}: damaged: changes {change.id} and {other.id} are not the halves of one move")


@cache
def _reader() -> TypeAdapter[PairTruth]:
    return TypeAdapter(PairTruth)


def write_labels(session: Path, index: int, instance: Int16Array, change: Int16Array) -> None:
    """Write the labels of one chunk, both (s, R, W)."""
    (session / "truth").mkdir(exist_ok=True)
    np.savez(session / "truth" / f"{index:05d}.npz", allow_pickle=False, instance=instance, change=change)


def write_true_poses(session: Path, world_T_sensor: Float64Array) -> None:
    """Write the (S, 4, 4) true poses of one session."""
    (session / "truth").mkdir(exist_ok=True)
    np.savez(session / "truth" / "poses.npz", allow_pickle=False, world_T_sensor=world_T_sensor)


def read_true_poses(session: Path) -> Float64Array:
    """Read the (S, 4, 4) true poses of one session.

    Raises:
        InputError: The file is missing or damaged, or a pose is too far away to be one.
    """
    path = session / "truth" / "poses.npz"
    world_T_sensor = read_npz(path, _POSES)["world_T_sensor"]
    if (np.abs(world_T_sensor) > FARTHEST_M).any():
        raise InputError(f"{path}: damaged: a pose is farther than {FARTHEST_M:g} m from the origin")
    return world_T_sensor


def write_mover_track(session: Path, track: MoverTrack) -> None:
    """Write where the movers of one session were."""
    (session / "truth").mkdir(exist_ok=True)
    np.savez(session / "truth" / "movers.npz", allow_pickle=False, **{name: getattr(track, name) for name in _TRACK})


def read_mover_track(session: Path) -> MoverTrack | None:
    """Read where the movers of one session were; None where none moved.

    Raises:
        InputError: The file is damaged, or a mover was seen too far away.
    """
    path = session / "truth" / "movers.npz"
    if not path.is_file():
        return None
    track = MoverTrack(**read_npz(path, _TRACK))
    # this form also refuses NaN
    if not (np.abs(track.seen_world[track.n_returns > 0]) <= FARTHEST_M).all():
        raise InputError(f"{path}: damaged: a mover was seen nowhere, or farther than {FARTHEST_M:g} m from the origin")
    return track


def read_labels(session: Path, n_chunks: int) -> Iterator[tuple[Int16Array, Int16Array]]:
    """Yield (instance, change) of every chunk, each (s, R, W) int16."""
    return (read_chunk_labels(session, index) for index in range(n_chunks))


def read_chunk_labels(session: Path, index: int) -> tuple[Int16Array, Int16Array]:
    """Read (instance, change) of one chunk, each (s, R, W) int16.

    Raises:
        InputError: The file is missing or damaged.
    """
    arrays = read_npz(session / "truth" / f"{index:05d}.npz", _LABELS)
    return arrays["instance"], arrays["change"]


def write_surface_labels(session: Path, index: int, displacement: Float32Array, surface_change: Int16Array) -> None:
    """Write displacement, metres, and surface change of one chunk, both (s, R, W)."""
    folder = session / "truth" / "surface"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{index:05d}.npz"
    np.savez(path, allow_pickle=False, displacement=displacement, surface_change=surface_change)


def read_chunk_surface(session: Path, index: int) -> tuple[Float32Array, Int16Array] | None:
    """Read displacement (s, R, W) float32 and surface change (s, R, W) int16 of one chunk; None where no rock changes.

    Raises:
        InputError: The file is missing though the session has others, or it is damaged.
    """
    folder = session / "truth" / "surface"
    if not folder.is_dir():
        return None
    arrays = read_npz(folder / f"{index:05d}.npz", _SURFACE)
    return arrays["displacement"], arrays["surface_change"]
