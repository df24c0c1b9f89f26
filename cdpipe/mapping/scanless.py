"""What can be done with a whole map without its scans, and what cannot."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import ScanSource

# Stages of the mapping that need scans: switched off.
_OFF = {"consistency": "none", "airborne": "keep", "movers": "keep"}
# Sources that compare points alone.
_SOURCES = ("m3c2", "m3c2-ep", "c2c", "voxel-diff")


def adapt_to_whole_maps(
    sources: Sequence[ScanSource], config: PipelineConfig, *, is_merge_known: bool
) -> PipelineConfig:
    """Return the settings for sessions of which one or both are maps without scans; others keep theirs.

    Raises:
        InputError: A stage asks what the sensor saw through, or the merge is to be searched.
    """
    scanless = [source.name for source in sources if getattr(source, "is_whole_map", False)]
    if not scanless:
        return config
    told = f"{scanless[0]}: one cloud, a map without its scans"
    if config.regions.source not in _SOURCES or config.extract.method != "clusters":
        raise InputError(
            f"{told}: where nothing was scanned cannot be told from what is gone, and regions.source = "
            f"{config.regions.source} with extract.method = {config.extract.method} asks that: use --preset m3c2, c2c "
            "or voxel-diff, which compare points alone (--surface goes with them); or name a folder with one file per "
            "scan and a trajectory, or the bag, OSF or PCAP it was made from"
        )
    if not is_merge_known:
        raise InputError(
            f"{told}: no place can be recognised in it: say --assume-aligned where both are in one frame, or "
            "--before-T-after FILE"
        )
    return config.model_copy(update={"map": config.map.model_copy(update=_OFF)})


def warn_of_whole_map(source: ScanSource) -> None:
    """Warn that the descriptors of a map without scans recognise no place."""
    if getattr(source, "is_whole_map", False):
        text = (
            f"{source.name}: one cloud, a map without its scans: no place is recognised by these descriptors, which "
            "are of its stations: detect needs --assume-aligned or --before-T-after FILE"
        )
        warnings.warn(text, InputWarning, stacklevel=3)
