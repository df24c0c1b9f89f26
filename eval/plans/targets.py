"""What a plan asks of the method it is about: bounds on figures of its tables, and shares of right merges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, Settings, validate
from eval.plans.files import read_plan
from eval.plans.variants import ORACLE_MERGE
from eval.plans.worlds import PairKind

RATE_COLUMN, PROPOSED = "recall_at_", "_proposed"
SURFACE_COLUMN = "surface_"


class Target(Settings):
    """A bound on one column of regions_table.csv, objects_table.csv or surface_table.csv.

    Attributes:
        column: The column.
        name: What the target is called in tables.
        domain: In or out of the training distribution; all pairs where neither this nor a site is set.
        site: Over the pairs with changes of the families whose name ends so, e.g. site1; the column is of results.csv.
        sensor: Over the pairs with this sensor, all domains together; the column is of results.csv.
        odometry: Over the pairs with this odometry, where the plan's figures are of another; the column is of a table.
        less_sensor: A sensor whose value on the same pairs (family and seed) is subtracted; with `sensor`.
        at_least: The lower bound.
        at_most: The upper bound; exactly one of the two is set.
        method: Of which method, where it is not the one that the targets are about.
        less: A rival whose value is subtracted first; for columns of one domain, and for the columns `surface_...` of
            surface_table.csv.
        least_km: No verdict where the unchanged pairs are shorter than this together.
    """

    column: str
    name: str
    domain: Literal["in", "out"] | None = None
    site: str = ""
    sensor: str = ""
    odometry: str = ""
    less_sensor: str = ""
    at_least: float | None = None
    at_most: float | None = None
    method: str = ""
    less: str = ""
    least_km: float = 0.0

    @model_validator(mode="after")
    def _is_complete(self) -> Target:
        if (self.at_least is None) == (self.at_most is None):
            raise ValueError("expected one of at_least and at_most")
        if sum(map(bool, (self.domain, self.site, self.sensor))) > 1:
            raise ValueError("expected one of domain, site and sensor")
        if self.less_sensor and not self.sensor:
            raise ValueError("less_sensor: for a target with a sensor")
        if self.less and self.domain is None and not self.column.startswith(SURFACE_COLUMN):
            raise ValueError(f"less: for a column of one domain, or {SURFACE_COLUMN}...")
        if self.odometry and (self.site or self.sensor or (self.less and self.column.startswith(RATE_COLUMN))):
            raise ValueError("odometry: for a column of a table, without site, sensor or a rate of a rival")
        return self

    @property
    def asked(self) -> str:
        """The bound in words."""
        return f"at least {self.at_least:g}" if self.at_least is not None else f"at most {self.at_most:g}"

    def is_met_by(self, value: float) -> bool:
        """Tell whether a value keeps the bound, but for rounding."""
        return value >= self.at_least - 1e-9 if self.at_least is not None else value <= (self.at_most or 0.0) + 1e-9


class Targets(Settings):
    """What a plan asks for.

    Attributes:
        method: The method that the plan is about; pages show its cases.
        odometry: The odometry of both sessions that the figures are of; "" where the plan does not tell them apart.
        sensor: The sensor profile that the figures are of; "" likewise.
        regions: Bounds on regions.
        objects: Bounds on objects.
        surface: Bounds on displacement of the rock.
        merge: By kind of pair, the share of the pairs that must do what the kind asks for
            (`eval.tables.merge_table.RULES`).
    """

    method: str = ""
    odometry: str = ""
    sensor: str = ""
    regions: tuple[Target, ...] = ()
    objects: tuple[Target, ...] = ()
    surface: tuple[Target, ...] = ()
    merge: dict[PairKind, Annotated[float, Field(gt=0, le=1)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _has_odometry(self) -> Targets:
        named = [each.name for each in (*self.regions, *self.objects, *self.surface) if each.odometry]
        if named and not self.odometry:
            raise ValueError(f"odometry of {named[0]}: the targets name none that the other figures are of")
        return self

    def share(self, pair_kind: str) -> float | None:
        """Return which share of the pairs of a kind must do what it asks for; None where no target is set."""
        return {str(kind): value for kind, value in self.merge.items()}.get(pair_kind)

    def shown_method(self, variants: Sequence[str]) -> str:
        """Return the variant whose cases are shown: the method, else the first that is no oracle, else the first."""
        if self.method in variants:
            return self.method
        return next((name for name in variants if not is_oracle(name)), variants[0])


def is_oracle(variant: str) -> bool:
    """Tell whether a variant merges by the truth."""
    return ORACLE_MERGE in variant.partition("[")[0].split("+")


def read_targets(provenance: Mapping[str, Any]) -> Targets:
    """Return the targets of the plan that a run was last run with.

    A run from before plans held targets has those of the shipped plan of the same name; none where there is no such
    plan.
    """
    plan = provenance.get("plan")
    if not isinstance(plan, Mapping):
        return Targets()
    document = plan.get("targets", plan.get("name"))
    try:
        return validate(_Section, Document("provenance.json", {"targets": document})).targets
    except InputError:
        return Targets()


def _take_from_plan(value: Any) -> Any:
    """Replace the name of a plan by the targets of that plan, which may in turn name another plan."""
    named: list[str] = []
    document = Document("", {})
    try:
        while isinstance(value, str):
            if value in named:
                raise ValueError(f"the targets of {value} are those of {value}")
            named.append(value)
            document = read_plan(value)
            if not isinstance(document.value, dict) or "targets" not in document.value:
                raise ValueError(f"{document.source}: expected a plan with targets")
            value = document.value["targets"]
        if named:
            return validate(_Section, replace(document, value={"targets": value})).targets
    except InputError as error:
        raise ValueError(str(error).replace("\n", "; ")) from error
    return {} if value is None else value


PlanTargets = Annotated[Targets, BeforeValidator(_take_from_plan)]


class _Section(Settings):
    targets: PlanTargets
