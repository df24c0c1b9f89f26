from .ouster import SensorMetadata, load_profile, parse_metadata, profile_names

__all__ = [
    "SensorMetadata",
    "load_profile",
    "parse_metadata",
    "profile_names",
]
