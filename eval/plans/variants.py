"""A variant or a grid point in one world: its method with its name, and its cells."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cdpipe.core.errors import InputError
from cdpipe.model.config import PipelineConfig, Site, load_config
from eval.oracles.merge import OracleMerge
from eval.plans.worlds import World

ORACLE_MERGE, ORACLE_REGIONS = "oracle-merge", "oracle-regions"
_ORACLE_PRESET = "tunnelcd"
Until = Literal["merge"]


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One scenario, one seed, one variant: one row of results.csv.

    Attributes:
        scenario: Label of its world: the scenario's name, with its settings in brackets.
        seed: Its seed.
        preset: Name of the preset.
        variant: Preset and the settings that name the variant.
        config: The effective settings.
        oracle: The oracle that merges instead of the method, or None.
        until: Last stage, None for the whole method.
        oracle_regions: Whether the regions come from the truth.
    """

    scenario: str
    seed: int
    preset: str
    variant: str
    config: PipelineConfig
    oracle: OracleMerge | None = None
    until: Until | None = None
    oracle_regions: bool = False


@dataclass(frozen=True, slots=True)
class Method:
    """A variant or a grid point in one world.

    Attributes:
        preset: The preset.
        named: Settings in its name.
        silent: Settings of the site, and its threshold; over those of the name.
        shared: Settings of all methods of the plan; under those of the name.
        site: Section of the preset that applies.
        oracle: The oracle that merges instead of the method, or None.
        oracle_regions: Whether the regions come from the truth.
    """

    preset: str
    named: tuple[str, ...]
    silent: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    site: Site = "narrow"
    oracle: OracleMerge | None = None
    oracle_regions: bool = False

    @property
    def variant(self) -> str:
        """Its name in tables."""
        return name_variant(self.preset, self.named, self.oracle, oracle_regions=self.oracle_regions)

    def config(self) -> PipelineConfig:
        """Return its effective settings.

        Raises:
            InputError: The settings contradict each other or the preset.
        """
        config = load_config(self.preset, [*self.shared, *self.named, *self.silent], self.site)
        if self.oracle_regions and config.extract.method == "clusters":
            raise InputError(
                f"{self.variant}: oracle_regions: extract.method = clusters takes those of regions.source: expected "
                "surface, voxel or nearest"
            )
        return config

    def cell(self, world: World, seed: int, config: PipelineConfig, until: Until | None) -> Cell:
        """Return its cell for one seed of a world."""
        preset = _strip_suffix(self.preset)
        return Cell(world.label, seed, preset, self.variant, config, self.oracle, until, self.oracle_regions)


def name_variant(
    preset: str, settings: Iterable[str], oracle: OracleMerge | None = None, *, oracle_regions: bool = False
) -> str:
    """Return the preset's name, followed by its settings in brackets where there are any.

    With a merge or regions from the truth the name is `oracle-merge`, `oracle-regions` or both joined by a plus. The
    brackets then begin with the preset (except `tunnelcd`) and the noise of the merge.
    """
    stem = _strip_suffix(preset)
    if oracle is not None or oracle_regions:
        of_preset = [] if stem == _ORACLE_PRESET else [f"preset={stem}"]
        settings = (*of_preset, *(() if oracle is None else oracle.settings), *settings)
        stem = "+".join([ORACLE_MERGE] * (oracle is not None) + [ORACLE_REGIONS] * oracle_regions)
    joined = ",".join(settings)
    return f"{stem}[{joined}]" if joined else stem


def _strip_suffix(preset: str) -> str:
    return Path(preset).stem if preset.endswith((".yaml", ".yml")) else preset
