from .movers import Mover, Stretch
from .odometry import FITTED_WALK, Odometry, source_of
from .platform import GAITS, Gait, Platform
from .props import PROP_KINDS, Aged, Area, Place, Prop, PropFile, PropKind, Shift
from .puddles import Puddle, PuddlePlace
from .scenario import Scenario
from .sensor import Sensor, Simulation
from .session import Air, Dust, Mist, SessionPlan
from .surface import SurfaceChange, SurfacePlace
from .tunnel import (
    Bolts,
    CableTray,
    Drift,
    Duct,
    Floor,
    Furniture,
    Markers,
    MeshFile,
    Niche,
    Pipe,
    Roughness,
    Ruts,
    Screen,
    Section,
    Stones,
    Tunnel,
    Variation,
)
from .values import Positive, Share

__all__ = [
    "FITTED_WALK",
    "GAITS",
    "PROP_KINDS",
    "Aged",
    "Air",
    "Area",
    "Bolts",
    "CableTray",
    "Drift",
    "Duct",
    "Dust",
    "Floor",
    "Furniture",
    "Gait",
    "Markers",
    "MeshFile",
    "Mist",
    "Mover",
    "Niche",
    "Odometry",
    "Pipe",
    "Place",
    "Platform",
    "Positive",
    "Prop",
    "PropFile",
    "PropKind",
    "Puddle",
    "PuddlePlace",
    "Roughness",
    "Ruts",
    "Scenario",
    "Screen",
    "Section",
    "Sensor",
    "SessionPlan",
    "Share",
    "Shift",
    "Simulation",
    "Stones",
    "Stretch",
    "SurfaceChange",
    "SurfacePlace",
    "Tunnel",
    "Variation",
    "source_of",
]
