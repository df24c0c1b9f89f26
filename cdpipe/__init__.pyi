from .core.errors import InputError, MergeFailedError, TunnelcdError
from .io.answer import read_answer, write_answer
from .io.readers import open_session as open_session
from .io.report_files import save_report
from .methods.registry import load_method
from .model.config import PipelineConfig, load_config, preset_names
from .model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape, SurfaceField, SurfaceRegion
from .model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, PosedScan, ScanSource
from .pipeline import Hooks, describe, detect, detect_changes, map_session, require_usable

__all__ = [
    "ChangeRegions",
    "ChangeReport",
    "ChangedObject",
    "DescriptorSet",
    "Hooks",
    "InputError",
    "MappedSession",
    "MergeFailedError",
    "MergedMaps",
    "ObjectShape",
    "PipelineConfig",
    "PointMap",
    "PosedScan",
    "ScanSource",
    "SurfaceField",
    "SurfaceRegion",
    "TunnelcdError",
    "describe",
    "detect",
    "detect_changes",
    "load_config",
    "load_method",
    "map_session",
    "open_session",
    "preset_names",
    "read_answer",
    "require_usable",
    "save_report",
    "write_answer",
]
