"""What a scenario is, once its seed has drawn every distribution. Lengths in metres, angles in degrees.

Frame: `world`, x forward, z up. A drift follows the polyline of its nodes; node z is floor level. Left and right of
furniture and niches are those of a drift's own direction, from its first node to its last; of a place those of the way
from the first to the second node of `between` (drawn places: as driven); of a session those of its drive.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, SerializerFunctionWrapHandler, field_serializer, model_serializer, model_validator

from cdpipe.core.yamlfile import Settings
from scenarios.dangling import find_dangling

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
SignedShare = Annotated[float, Field(ge=-1, le=1)]
Reflectivity = Annotated[float, Field(gt=0, le=1)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Side = Literal["left", "right"]
PropKind = Literal[
    "box", "crate", "chair", "trolley", "barrel", "cone", "railing", "pallet", "rock", "vehicle", "muck_pile", "mesh"
]
PROP_KINDS: tuple[str, ...] = get_args(PropKind)


def _with_usual(given: Any, usual: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return what is given of a thing of several kinds, with the usual values of the keys that its kind has."""
    if not isinstance(given, dict):
        return given
    said = {key: value for key, value in given.items() if value is not None}
    return {**usual.get(str(given.get("kind")), {}), **said}


def _refuse_others(thing: Any, usual: Mapping[str, Mapping[str, Any]], what: str) -> None:
    """Raise `ValueError` where a thing says a key that other kinds have and its own has not."""
    known = {key for keys in usual.values() for key in keys}
    said = sorted(key for key in known - usual[thing.kind].keys() if getattr(thing, key) is not None)
    if said:
        raise ValueError(f"{what}: a {thing.kind} has no {', '.join(said)}: leave that out")


class Lean(Settings):
    """Settings that leave keys added later out of their dump while these have their defaults.

    So the truth of an older scenario keeps its bytes.
    """

    _LATER: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _leave_out(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        dumped: dict[str, Any] = handler(self)
        is_later = {key: key in self._LATER and getattr(self, key) == fields[key].default for key in dumped}
        return {key: value for key, value in dumped.items() if not is_later[key]}


class Section(Settings):
    """Cross-section of a drift at its nominal size; in a foreign mesh about how wide and high its drifts are."""

    shape: Literal["horseshoe", "d", "arch", "rectangle", "cave"] = "horseshoe"
    width_m: Positive = 5.0
    height_m: Positive = 4.0


class Variation(Settings):
    """Slow change of width and of height along every drift."""

    share: Annotated[float, Field(ge=0, le=0.4)]  # standard deviation, as a share of the nominal size
    length_m: Positive = 12.0  # correlation length


class Roughness(Settings):
    """One octave of overbreak: smooth noise of this amplitude (standard deviation) and correlation length."""

    amplitude_m: NotNegative
    length_m: Positive


class Ruts(Settings):
    """Two wheel tracks along the middle of every drift."""

    depth_m: Positive
    gauge_m: Positive = 1.6  # between the middles of the two tracks
    width_m: Positive = 0.45


class Stones(Settings):
    """Loose fragments on the floor, sizes after Rosin-Rammler, smaller ones left out."""

    per_m2: NotNegative
    size_m: Positive = 0.12  # characteristic size
    max_size_m: Positive = 0.35


class Floor(Settings):
    """What makes the floor more than a plane."""

    roughness: Share = 0.3  # share of the wall's roughness that the floor has
    crossfall_percent: Finite = 0.0  # falls to the right where positive
    ruts: Ruts | None = None
    stones: Stones | None = None


class Drift(Settings):
    """A drift through two or more nodes; its own section if it differs from the tunnel's."""

    nodes: Annotated[tuple[str, ...], Field(min_length=2)]
    section: Section | None = None


class Niche(Settings):
    """A recess in one wall, floor level with the drift's."""

    between: tuple[str, str]
    fraction: Share
    side: Side
    width_m: Positive
    depth_m: Positive
    height_m: Positive


class Pipe(Settings):
    """A pipe on brackets along one wall of every drift."""

    diameter_m: Positive
    side: Side
    height_share: Share = 0.5  # of the drift's height


class Duct(Settings):
    """A ventilation duct hung below the roof of every drift."""

    diameter_m: Positive
    lateral: SignedShare = 0.5  # -1 right, +1 left


class CableTray(Settings):
    """A cable tray on brackets along one wall of every drift, with cables in it."""

    width_m: Positive = 0.3
    side: Side = "left"
    height_share: Share = 0.7


class Bolts(Settings):
    """Rock bolts with plates, in a square pattern over roof and upper walls."""

    spacing_m: Positive = 1.2


class Screen(Settings):
    """Welded wire mesh on roof and shoulders, in panels."""

    share: Share = 1.0  # of the length of every drift
    opening_m: Positive = 0.1


class Markers(Settings):
    """Plates of retroreflecting sheet, flat along one wall of every drift, as chainage is marked."""

    every_m: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 10.0
    size_m: Positive = 0.3
    side: Side = "left"
    height_share: Share = 0.3  # of the drift's height


class Furniture(Lean):
    """What is fixed to the rock in both sessions and must never count as a change."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"markers"})

    pipes: tuple[Pipe, ...] = ()
    ducts: tuple[Duct, ...] = ()
    cable_trays: tuple[CableTray, ...] = ()
    bolts: Bolts | None = None
    screen: Screen | None = None
    markers: Markers | None = None


class MeshFile(Settings):
    """A surface someone else made: STL, OBJ, PLY or GLB. A relative path starts at the scenario's file."""

    path: Annotated[str, Field(pattern=r"^[^\x00]+$")]
    units: Literal["m", "cm", "mm", "in", "ft"] = "m"
    up: Literal["x", "y", "z"] = "z"  # which axis of the file points up
    flip: bool = False  # turn the surface inside out
    allow_open: bool = False  # rays may leave through its holes


class Tunnel(Settings):
    """The walls: a graph of drifts, meshed from one signed distance field; or a mesh that nodes and drifts lie in."""

    mesh: MeshFile | None = None
    nodes: dict[str, tuple[Finite, Finite, Finite]] = Field(default_factory=dict)
    drifts: tuple[Drift, ...] = ()
    niches: tuple[Niche, ...] = ()
    section: Section = Section()
    variation: Variation | None = None
    roughness: tuple[Roughness, ...] = ()
    floor: Floor = Floor()
    meander_m: NotNegative = 0.0  # amplitude of the sideways wander of every centreline
    meander_length_m: Positive = 25.0
    furniture: Furniture = Furniture()
    resolution_m: Positive = 0.15  # edge of the marching-cubes cell
    reflectivity: Reflectivity = 0.25

    @model_validator(mode="after")
    def _has_walls(self) -> Tunnel:
        if not self.drifts and self.mesh is None:
            raise ValueError("a tunnel needs drifts, or a mesh")
        return self


class Area(Settings):
    """A stretch of the tunnel that both sessions drive, where things change; the seed draws where it lies.

    Areas keep as far from one another as four score radii where the tunnel is long enough.
    """

    name: str
    length_m: Positive = 6.0


class Place(Settings):
    """Where a prop stands: between two nodes, at a point, in an area, or (none of these) anywhere on the way.

    In the last two cases the seed draws the station, and draws again until the prop fits and stands in no other.
    """

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes
    at: tuple[Finite, Finite, Finite] | None = None  # world; the floor is looked for below it
    area: str | None = None
    lateral: SignedShare = 0.0  # -1 right wall, +1 left wall, of the width the prop leaves free
    yaw_deg: Finite = 0.0  # against the direction of the drift; with `at` against the x axis
    posture: Literal["upright", "tipped", "leaning"] = "upright"  # leaning: against the nearer wall; a pile: banked up

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> Place:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if sum(way is not None for way in (self.between, self.at, self.area)) > 1:
            raise ValueError("give one of between, at and area")
        return self


class PropFile(Settings):
    """A kind of prop on the search path: a surface, and how much light it sends back."""

    mesh: MeshFile  # a relative path starts at this file
    reflectivity: Reflectivity | None = None


class Shift(Settings):
    """A short move from where a prop stands."""

    distance_m: Positive
    heading_deg: Finite = 0.0  # direction, against that of the drift
    turn_deg: Finite = 0.0


class Aged(Settings):
    """What time did to a prop that nobody touched: in the after session it stands a little otherwise; no change.

    The pose of the before session is displaced as a whole; nothing settles again.
    """

    shift_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    heading_deg: Finite = 0.0  # direction of the shift, against the x axis of the world
    turn_deg: Annotated[float, Field(ge=-20, le=20)] = 0.0
    lean_deg: Annotated[float, Field(ge=-20, le=20)] = 0.0  # about the prop's own x axis
    sag_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # into the floor


class Prop(Lean):
    """An object on the floor. What happens to it between the sessions is its `change`."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"aged"})

    name: str
    kind: str  # a PropKind, or the name of a prop on the search path, which has a mesh
    size_m: tuple[Positive, Positive, Positive] | None = None  # length, width, height when upright; a mesh has its own
    mesh: MeshFile | None = None
    place: Place = Place()
    change: Literal["none", "added", "removed", "moved", "reshaped"] = "none"
    to: Place | None = None  # where a moved prop stands in the after session
    shift: Shift | None = None  # or how far from its first place
    aged: Aged | None = None  # of a prop that stays: how it stands in the after session
    loaded_share: Annotated[float, Field(gt=0, lt=1)] | None = None  # of a reshaped pile's volume, taken away
    repose_deg: Annotated[float, Field(ge=30, le=45)] = 37.0  # flanks of a pile; blasted rock has 34 to 40
    fragment_m: Annotated[float, Field(ge=0.02, le=2.0)] = 0.25  # characteristic size of a pile's fragments
    reflectivity: Reflectivity | None = None  # of every part; left out: what each part is made of

    @model_validator(mode="after")
    def _parts_go_together(self) -> Prop:
        if self.mesh is None and self.kind not in PROP_KINDS:
            raise ValueError(f"prop {self.name!r}: no prop is called {self.kind}")
        if (self.kind not in PROP_KINDS or self.kind == "mesh") != (self.mesh is not None):
            raise ValueError(f"prop {self.name!r}: kind: mesh and a file `mesh` go together")
        if (self.mesh is None) == (self.size_m is None):
            wanted = (
                "size_m: [length, width, height] is missing"
                if self.mesh is None
                else "a mesh has its own size: leave size_m out"
            )
            raise ValueError(f"prop {self.name!r}: {wanted}")
        if (self.change == "moved") != ((self.to is not None) != (self.shift is not None)):
            raise ValueError(f"prop {self.name!r}: change: moved goes with a place `to` or a `shift`, not both")
        if (self.change == "reshaped") != (self.loaded_share is not None):
            raise ValueError(f"prop {self.name!r}: change: reshaped and loaded_share go together")
        if self.aged is not None and self.change != "none":
            raise ValueError(f"prop {self.name!r}: aged: only of a prop that stays (change: none)")
        if self.change == "reshaped" and self.kind != "muck_pile":
            raise ValueError(f"prop {self.name!r}: only a muck_pile can be reshaped")
        if self.kind in ("muck_pile", "railing") and "tipped" in (self.place.posture, self.to and self.to.posture):
            raise ValueError(f"prop {self.name!r}: a {self.kind} is set into the floor, it cannot be tipped")
        return self


class Sensor(Lean):
    """The LiDAR: an Ouster profile (shipped name or metadata .json), its mode, and which effects are on.

    Every effect is a switch, so its influence on a result can be measured. sim/sensor/SENSOR.md names the constants.
    """

    _LATER: ClassVar[frozenset[str]] = frozenset({"returns", "retroreflectors", "glass"})

    profile: str = "os1-32-nominal"
    mode: Annotated[str, Field(pattern=r"^\d+x\d+$")] = "1024x10"
    rolling_scan: bool = True  # a pose per column; off: the sensor stands still during each revolution
    range_noise: bool = True  # by range and by the strength of the return
    dropouts: bool = True  # weak returns are lost: reflectivity, incidence, range
    returns: Literal["strongest", "last", "dual"] = "strongest"  # of the echoes of a beam; dual: the two strongest
    sub_rays: Literal[1, 7, 19] = 1  # rays over each beam's width; 1: no divergence, no mixed pixels at edges
    false_positives: bool = True  # returns where nothing is
    retroreflectors: bool = False  # reflecting bands and plates are dazzling; off: they are white
    glass: bool = False  # panes let light through and mirror it; off: they are dark walls
    range_step_mm: Literal[1, 8] = 1  # 8: the vendor's low-bandwidth packets
    max_range_m: Annotated[float, Field(gt=0, le=524)] = 120.0  # the vendor's range field: 19 bits of millimetres
    min_range_m: NotNegative = 0.3

    @property
    def n_returns(self) -> int:
        """How many returns of a beam are recorded at most."""
        return 2 if self.returns == "dual" else 1

    @model_validator(mode="after")
    def _sees_something(self) -> Sensor:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m = {self.min_range_m:g} leaves nothing below max_range_m")
        return self


class Simulation(Settings):
    """How a session is computed: not what is in the world, so `before` and `after` have the same."""

    backend: Literal["embree", "warp"] = "embree"  # casts the sensor's rays; warp: on a GPU where there is one


class Gait(Settings):
    """What walking adds to the movement of the sensor: amplitudes of oscillations; a stride is two steps."""

    step_hz: Annotated[float, Field(gt=0, le=5)]  # steps a second
    bob_m: NotNegative  # up and down, once a step
    sway_m: NotNegative  # to the sides, once a stride
    pitch_deg: NotNegative  # once a step
    roll_deg: NotNegative  # once a stride
    yaw_deg: NotNegative  # once a stride


# Of platforms that walk. A hand: fitted to real walks; a legged robot: unverified (sim/drive/DRIVES.md).
GAITS: dict[str, dict[str, float]] = {
    "handheld": {"step_hz": 1.4, "bob_m": 0.05, "sway_m": 0.08, "pitch_deg": 0.5, "roll_deg": 0.4, "yaw_deg": 0.95},
    "legged": {"step_hz": 2.6, "bob_m": 0.012, "sway_m": 0.01, "pitch_deg": 1.0, "roll_deg": 1.0, "yaw_deg": 0.5},
}


class Platform(Lean):
    """What carries the sensor, and how the sensor is mounted on it."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"mount_yaw_deg", "mount_pitch_deg", "gait"})

    kind: Literal["ground_robot", "quadrotor", "handheld", "legged"] = "ground_robot"
    sensor_height_m: Positive = 0.8  # above the floor
    speed_mps: Positive = 1.0
    speed_variation: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # standard deviation, as a share of the speed
    scan_spacing_m: Positive = 0.25  # path between the recorded revolutions
    clearance_m: Positive = 0.5  # kept to walls and props
    wheelbase_m: Positive = 0.6  # the robot's four wheels or feet find the floor: roll, pitch and bounce follow
    track_m: Positive = 0.5
    tilt_deg: NotNegative = 1.0  # standard deviation of roll and pitch on top of that
    bounce_m: NotNegative = 0.0  # and of the height
    wander_m: NotNegative = 0.0  # standard deviation of the line from side to side, where there is room
    mount_yaw_deg: Finite = 0.0  # of the sensor's x axis against the platform's, to the left; recorded drives have none
    mount_pitch_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0  # of the sensor then, nose down positive
    gait: Gait | None = None  # of a platform that walks; keys left out are those of its kind

    @model_validator(mode="before")
    @classmethod
    def _walk(cls, given: Any) -> Any:
        usual = GAITS.get(str(given.get("kind"))) if isinstance(given, dict) else None
        gait = given.get("gait") or {} if usual else None
        return {**given, "gait": usual | gait} if usual and isinstance(gait, dict) else given

    @model_validator(mode="after")
    def _only_walkers_have_a_gait(self) -> Platform:
        if self.gait is not None and self.kind not in GAITS:
            raise ValueError(f"a {self.kind} has no gait: leave gait out, or give kind {' or '.join(GAITS)}")
        return self


DEFAULT_SOURCE = "drift"
# The random walk fitted to KISS-ICP on validation pairs of narrow, wide and cave together: sim/drive/DRIVES.md.
FITTED_WALK: dict[str, float] = {
    "scale_percent": 0.88,
    "scale_length_m": 1.0,
    "yaw_deg_per_m": 0.0048,
    "yaw_length_m": 23.0,
    "tilt_deg": 0.34,
    "tilt_length_m": 200.0,
    "jitter_along_m": 0.032,
    "jitter_across_m": 0.0056,
    "jitter_yaw_deg": 0.034,
    "jitter_roll_deg": 0.29,
    "jitter_pitch_deg": 0.054,
}
_KEYS_OF_SOURCE: dict[str, tuple[str, ...]] = {
    "drift": ("translation_percent", "yaw_deg_per_100m"),
    "kiss-icp": (),
    "random-walk": tuple(FITTED_WALK),
    "file": ("file",),
}


def source_of(odometry: dict[str, Any]) -> Any:
    """Return the source that a plain tree of `Odometry` names; a file names itself."""
    return odometry.get("source", "file" if "file" in odometry else DEFAULT_SOURCE)


class Odometry(Lean):
    """What a session's poses come from.

    - `drift`: truth with a systematic error in KITTI's terms, its signs drawn from the seed; both figures 0: truth.
    - `random-walk`: truth with the errors of a scan-matching odometry, drawn from the seed. Errors of scale, yaw rate
      and tilt are first-order Gauss-Markov processes over the path; jitter is white noise of each revolution's pose.
      Keys left out have the values fitted to KISS-ICP.
    - `kiss-icp`: KISS-ICP on the session's own scans.
    - `file`: the poses of a TUM file; naming the file is enough.
    """

    _LATER: ClassVar[frozenset[str]] = frozenset({*FITTED_WALK, "file"})

    source: Literal["drift", "kiss-icp", "random-walk", "file"] = "drift"
    translation_percent: NotNegative = 0.0
    yaw_deg_per_100m: NotNegative = 0.0
    scale_percent: NotNegative | None = None  # standard deviation of the error of scale
    scale_length_m: Positive | None = None  # correlation length of the error of scale
    yaw_deg_per_m: NotNegative | None = None  # standard deviation of the error of the yaw rate
    yaw_length_m: Positive | None = None
    tilt_deg: NotNegative | None = None  # standard deviation of the error of roll and of pitch, which gravity bounds
    tilt_length_m: Positive | None = None
    jitter_along_m: NotNegative | None = None  # standard deviation of each pose along the direction of travel
    jitter_across_m: NotNegative | None = None  # and to the side and up
    jitter_yaw_deg: NotNegative | None = None
    jitter_roll_deg: NotNegative | None = None  # about the direction of travel
    jitter_pitch_deg: NotNegative | None = None
    file: Annotated[str, Field(pattern=r"^[^\x00]+$")] | None = (
        None  # TUM file of odom_T_sensor; from the scenario's file
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        source = source_of(given)
        said = {key: value for key, value in given.items() if value is not None}
        return {"source": source, **(FITTED_WALK if source == "random-walk" else {}), **said}

    @model_validator(mode="after")
    def _one_source(self) -> Odometry:
        fields = type(self).model_fields
        for source, keys in _KEYS_OF_SOURCE.items():
            said = [key for key in keys if getattr(self, key) != fields[key].default]
            if source != self.source and said:
                raise ValueError(
                    f"source {self.source} has no {', '.join(said)} (of source {source}): leave that out, "
                    f"or give source: {source}"
                )
        if self.source == "file" and self.file is None:
            raise ValueError("source file needs file: the name of a TUM file")
        return self


class Mist(Settings):
    """Droplets of water, everywhere alike."""

    visibility_m: Annotated[float, Field(ge=5, le=2000)]  # meteorological optical range: 5 % of the contrast is left


class Dust(Settings):
    """Mineral dust, denser near the floor, in swathes that drift."""

    mg_per_m3: Annotated[float, Field(gt=0, le=5000)]  # mean at the floor
    scale_height_m: Positive = 2.0  # height above the floor at which 37 % are left
    patch_m: Annotated[float, Field(ge=2, le=40)] = 4.0  # correlation length of the swathes
    contrast: Annotated[float, Field(ge=0, le=1.5)] = 0.7  # standard deviation of the logarithm of the density
    drift_mps: NotNegative = 0.3  # speed of the air


class Air(Settings):
    """What is in the air of one session; the truth labels its returns."""

    mist: Mist | None = None
    dust: Dust | None = None


class SessionPlan(Lean):
    """One drive through the tunnel: along a route, or on a recorded trajectory."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"air", "sensor", "platform"})

    route: tuple[str, ...] = ()
    trajectory: str | None = None  # TUM file of world_T_sensor, instead of a route; from the scenario's file
    lateral: SignedShare = 0.0  # which line: -1 right, +1 left, of the width the platform leaves free
    start_m: NotNegative = 0.0  # path left out at the start of the route
    end_m: NotNegative = 0.0  # and at its end
    height_m: Positive | None = None  # instead of platform.sensor_height_m
    speed_mps: Positive | None = None  # instead of platform.speed_mps
    odometry: Odometry = Odometry()
    air: Air | None = None  # mist and dust; left out: clear
    sensor: Sensor | None = None  # of this session alone; keys left out are those of the scenario's sensor
    platform: Platform | None = None  # likewise

    @field_serializer("sensor", "platform")
    def _dump_whole(self, part: Sensor | Platform | None) -> dict[str, Any] | None:
        """Dump every key: one that was left out would be the scenario's when read again."""
        if part is None:
            return None
        lean = part.model_dump(mode="json")
        return {name: lean.get(name, getattr(part, name)) for name in type(part).model_fields}

    @model_validator(mode="after")
    def _route_or_trajectory(self) -> SessionPlan:
        if len(self.route) == 1 or bool(self.route) == (self.trajectory is not None):
            raise ValueError("give a route of two nodes or more, or a trajectory")
        of_a_route = {"lateral": 0.0, "start_m": 0.0, "end_m": 0.0, "height_m": None, "speed_mps": None}
        said = [name for name, left_out in of_a_route.items() if getattr(self, name) != left_out]
        if self.trajectory is not None and said:
            raise ValueError(f"a trajectory is driven as recorded: leave {', '.join(said)} out")
        return self


class Stretch(Settings):
    """Where a mover goes to and fro: between two nodes, in an area, or (neither) anywhere on the way of the drives.

    In the last two cases the seed draws a stretch of `length_m`, and draws again until nothing is in its way.
    """

    between: tuple[str, str] | None = None
    fractions: tuple[Share, Share] | None = None  # of the way between the two nodes: where it starts and turns round
    area: str | None = None
    length_m: Positive = 8.0  # of a stretch that the seed draws
    lateral: SignedShare | None = None  # -1 right wall, +1 left wall, of the width the mover leaves free; None: drawn

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> Stretch:
        if (self.between is None) != (self.fractions is None):
            raise ValueError("between and fractions go together")
        if self.between is not None and self.area is not None:
            raise ValueError("give between or area, not both")
        return self


# What each kind of mover is like where its keys are left out; a kind has these keys and no other of them.
USUAL_MOVERS: dict[str, dict[str, Any]] = {
    "person": {"speed_mps": 1.3, "pause_s": 2.0, "height_m": 1.75},
    "forklift": {"speed_mps": 2.0, "pause_s": 4.0, "size_m": (3.4, 1.15, 2.1)},
    "loader": {"speed_mps": 2.0, "pause_s": 6.0, "size_m": (8.6, 2.2, 2.2)},
    "curtain": {"width_m": 1.6, "swing_deg": 10.0},
}


class PuddlePlace(Settings):
    """Where water stands: a share of the way between two nodes, in an area, or anywhere on the way of the drives."""

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes
    area: str | None = None
    lateral: SignedShare | None = None  # of its middle: -1 right wall, +1 left wall; None: drawn

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> PuddlePlace:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if self.between is not None and self.area is not None:
            raise ValueError("give between or area, not both")
        return self


class Puddle(Settings):
    """Standing water: a level sheet that covers the lowest part of the floor around a place. Never a change.

    sim/sensor/SENSOR.md says what the sensor sees of it.
    """

    name: str
    sessions: Literal["both", "before", "after"] = "both"
    place: PuddlePlace = PuddlePlace()
    radius_m: Annotated[float, Field(gt=0, le=10)] = 1.5  # it reaches no farther than this from its middle
    depth_m: Annotated[float, Field(gt=0, le=0.5)] = 0.05  # above the lowest place of the floor within that


SurfaceKind = Literal["convergence", "heave", "shotcrete", "scar", "fill", "face"]
# What each kind of surface change is like where its keys are left out; a kind has these keys and no other of them.
USUAL_SURFACES: dict[str, dict[str, Any]] = {
    "convergence": {"depth_m": 0.03, "length_m": 4.0, "sector_deg": (40.0, 120.0)},
    "heave": {"depth_m": 0.05, "length_m": 5.0, "sector_deg": (140.0, 220.0)},
    "shotcrete": {"thickness_m": 0.05, "length_m": 4.0, "sector_deg": (-105.0, 105.0)},
    "scar": {"depth_m": 0.4, "length_m": 1.6, "sector_deg": (30.0, 70.0), "swell": 1.45},
    "fill": {"height_m": 0.4, "length_m": 8.0},
    "face": {"advance_m": 3.0},
}


class SurfacePlace(Settings):
    """Where rock changes: between two nodes, in an area, at a blind end, or anywhere on the way of the drives."""

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes: the middle of the change
    area: str | None = None
    node: str | None = None  # the blind end of a drift: where a face advances, and from where fill reaches back

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> SurfacePlace:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if sum(way is not None for way in (self.between, self.area, self.node)) > 1:
            raise ValueError("give one of between, area and node")
        return self


class SurfaceChange(Settings):
    """Rock that moves, comes or goes between the sessions. sim/displacement/DISPLACEMENT.md has every kind.

    Sectors are degrees about the drift's axis, looking along it: 0 the crown of the roof, 90 the left wall, 180 the
    floor. They may go beyond 180: [140, 220] is the middle of the floor.
    """

    name: str
    kind: SurfaceKind
    place: SurfacePlace = SurfacePlace()
    depth_m: Annotated[float, Field(gt=0, le=2)] | None = None  # largest, of convergence, heave, scar
    thickness_m: Annotated[float, Field(gt=0, le=0.3)] | None = None  # of shotcrete
    height_m: Annotated[float, Field(gt=0, le=3)] | None = None  # of fill above the floor
    advance_m: Annotated[float, Field(gt=0, le=4.5)] | None = None  # of a face
    length_m: Annotated[float, Field(ge=0.5, le=60)] | None = None  # along the drift
    sector_deg: tuple[Degrees, Degrees] | None = None
    swell: Annotated[float, Field(ge=1, le=2)] | None = None  # volume of the rubble over that of the scar

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        return _with_usual(given, USUAL_SURFACES)

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> SurfaceChange:
        _refuse_others(self, USUAL_SURFACES, f"surface {self.name!r}")
        if self.sector_deg is not None and not 5 <= self.sector_deg[1] - self.sector_deg[0] <= 360:
            raise ValueError(f"surface {self.name!r}: sector_deg: from and to are 5 to 360 degrees apart, from first")
        if self.kind == "face" and (self.place.between or self.place.area):
            raise ValueError(f"surface {self.name!r}: a face is at a node, the blind end of a drift")
        if self.place.node is not None and self.kind not in ("face", "fill"):
            raise ValueError(f"surface {self.name!r}: only a face or fill has place.node: give between and fraction")
        return self


class Mover(Lean):
    """Something that moves while a session is recorded; never a change. sim/movers/MOVERS.md has every kind."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"dust_mg_per_m"})

    name: str
    kind: Literal["person", "forklift", "loader", "curtain"]
    sessions: Literal["both", "before", "after"] = "both"
    path: Stretch = Stretch()
    speed_mps: NotNegative | None = None  # 0: a person stands at the start of the stretch; a curtain has none
    pause_s: NotNegative | None = None  # at either end; a person turns round meanwhile, a machine lifts or lowers
    height_m: Annotated[float, Field(ge=1.2, le=2.2)] | None = None  # of a person
    size_m: tuple[Positive, Positive, Positive] | None = None  # of a machine: length, width, height
    width_m: Positive | None = None  # of a curtain; it hangs from the roof down to the floor
    swing_deg: Annotated[float, Field(ge=0, le=30)] | None = None  # amplitude of a curtain's lowest strip
    reflectivity: Reflectivity | None = None  # of every part; left out: what each part is made of
    dust_mg_per_m: Annotated[float, Field(ge=0, le=10000)] | None = None  # that a machine raises on its way

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        return _with_usual(given, USUAL_MOVERS)

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> Mover:
        _refuse_others(self, USUAL_MOVERS, f"mover {self.name!r}")
        if self.dust_mg_per_m is not None and self.kind not in ("forklift", "loader"):
            raise ValueError(f"mover {self.name!r}: a {self.kind} raises no dust: leave dust_mg_per_m out")
        if self.speed_mps == 0 and self.kind != "person":
            raise ValueError(f"mover {self.name!r}: a {self.kind} that never moves is a prop: give it a speed_mps")
        return self


def _fill_in(scenario: dict[Any, Any], plan: Any) -> Any:
    """Return the plain tree of a session with the keys that its own sensor and platform leave out."""
    if not isinstance(plan, dict):
        return plan
    filled = dict(plan)
    for part in ("sensor", "platform"):
        usual, own = scenario.get(part), plan.get(part)
        if isinstance(usual, dict) and isinstance(own, dict):
            filled[part] = usual | own
            if own.get("kind", usual.get("kind")) != usual.get("kind"):  # another kind of platform has another gait
                filled[part]["gait"] = own.get("gait")
            elif isinstance(own.get("gait"), dict) and isinstance(usual.get("gait"), dict):
                filled[part]["gait"] = usual["gait"] | own["gait"]
    return filled


class Scenario(Lean):
    """A world, what changes in it, what moves in it, and the two drives."""

    _LATER: ClassVar[frozenset[str]] = frozenset({"movers", "puddles", "surface", "sim"})

    family: str
    description: str = ""
    score_radius_m: Positive = 4.5
    tunnel: Tunnel
    areas: tuple[Area, ...] = ()
    props: tuple[Prop, ...] = ()
    movers: tuple[Mover, ...] = ()
    puddles: tuple[Puddle, ...] = ()
    surface: tuple[SurfaceChange, ...] = ()
    sensor: Sensor = Sensor()
    platform: Platform = Platform()
    sim: Simulation = Simulation()
    before: SessionPlan
    after: SessionPlan

    @model_validator(mode="before")
    @classmethod
    def _fill_in_sessions(cls, given: Any) -> Any:
        """Give each session's own sensor and platform the keys that it leaves out."""
        if not isinstance(given, dict):
            return given
        return {**given, **{name: _fill_in(given, given[name]) for name in ("before", "after") if name in given}}

    def plan(self, session: str) -> SessionPlan:
        """Return the drive of one session."""
        return self.after if session == "after" else self.before

    def of(self, session: str) -> Scenario:
        """Return the scenario as one session has it: with the sensor and the platform of this session."""
        plan = self.plan(session)
        own = {"sensor": plan.sensor or self.sensor, "platform": plan.platform or self.platform}
        return self if plan.sensor is None and plan.platform is None else self.model_copy(update=own)

    @model_validator(mode="after")
    def _references_hold(self) -> Scenario:
        for key, rule in find_dangling(self.model_dump(mode="json")):
            raise ValueError(f"{'.'.join(map(str, key))}: {rule}")
        return self
