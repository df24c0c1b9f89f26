from .comparison import (
    SOURCES_AT_KEYFRAMES,
    WHOLE_MAP_SOURCES,
    ClusterConfig,
    ExtractConfig,
    OutlierConfig,
    QueryConfig,
    RegionsConfig,
)
from .idle import (
    explain_idle_setting,
    explain_unread_setting,
    list_idle_settings,
    list_unread_settings,
    require_settings_are_read,
    warn_of_unread_settings,
)
from .mapping import DescriptorConfig, MapConfig, MergeConfig, SphereConfig
from .pipeline import OF_WHOLE_MAPS, PipelineConfig, setting_fields, settings_table
from .presets import WEIGHTS, WEIGHTS_FILES, Site, load_config, preset_files, preset_names
from .surface import SurfaceConfig
from .whole_maps import ErasorConfig, M3C2Config, M3C2EPConfig, RangeNetConfig

__all__ = [
    "OF_WHOLE_MAPS",
    "SOURCES_AT_KEYFRAMES",
    "WEIGHTS",
    "WEIGHTS_FILES",
    "WHOLE_MAP_SOURCES",
    "ClusterConfig",
    "DescriptorConfig",
    "ErasorConfig",
    "ExtractConfig",
    "M3C2Config",
    "M3C2EPConfig",
    "MapConfig",
    "MergeConfig",
    "OutlierConfig",
    "PipelineConfig",
    "QueryConfig",
    "RangeNetConfig",
    "RegionsConfig",
    "Site",
    "SphereConfig",
    "SurfaceConfig",
    "explain_idle_setting",
    "explain_unread_setting",
    "list_idle_settings",
    "list_unread_settings",
    "load_config",
    "preset_files",
    "preset_names",
    "require_settings_are_read",
    "setting_fields",
    "settings_table",
    "warn_of_unread_settings",
]
